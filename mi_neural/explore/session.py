"""A picture that improves while a cache learns: what a live view shows, without a widget."""

from __future__ import annotations

import math
import time

import mitsuba as mi
import numpy as np

from mi_neural.bench.budget import STREAM_IMAGE, pass_seed, placed, render_pass, reset, statistics
from mi_neural.bench.load import split_channels
from mi_neural.bench.reference import load_reference
from mi_neural.explore import controls
from mi_neural.image import exr, metrics
from mi_neural.image.moments import Accumulator
from mi_neural.render.film import sensor_of


class Session:
    """A scene being rendered, frame by frame, by an integrator that may learn on the way.

    scene        a ``mi.Scene``
    integrator   an integrator, a plugin's name, a dictionary for ``mi.load_dict``, or None: the scene's own
    sensor       number of the sensor
    reference    linear RGB of shape (height, width, 3), or a file that holds it; measured against while camera and
                 lights are as at the start
    spp          samples a pixel of a frame
    seed         of the samples

    A frame trains (`train_steps` of the integrator), renders, and joins the mean of the frames since the last change.
    Where something learns, frame k counts k times, so that what was seen of the untrained cache fades as 1/n^2; the
    noise is that of 3/4 of the samples.
    """

    def __init__(self, scene, integrator=None, sensor: int = 0, reference=None, spp: int = 1, seed: int = 0) -> None:
        if spp < 1:
            raise ValueError(f"spp is {spp}; it must be at least 1")
        sensor_of(scene, sensor, "live")
        self.scene, self.sensor, self.spp, self.seed = scene, sensor, spp, seed
        self.integrator = _integrator(scene, integrator)
        self.camera = controls.Camera(scene, sensor)
        self.lights = controls.lights(scene, self.camera.up)
        self.reference = None if reference is None else _reference(reference, self.size)
        self.n_frames = 0
        self.curve: list[tuple[float, str, float]] = []  # (seconds of rendering, quantity, value)
        self.seconds = 0.0
        self.restart()

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the picture."""
        return tuple(int(n) for n in self.scene.sensors()[self.sensor].film().crop_size())

    @property
    def learns(self) -> bool:
        """Whether something is being trained."""
        return math.isfinite(self.loss) and not getattr(self.integrator, "freeze_cache", False)

    # -------------------------------------------------------------------------------------------------------------
    # Frames

    def frame(self) -> None:
        """Train, render `spp` samples a pixel more, and take them into the picture."""
        start, it = time.perf_counter(), self.integrator
        cumulative = getattr(it, "cumulative", False)
        if hasattr(it, "plan_samples"):
            if not cumulative:
                it.plan_samples(None)  # so that each frame trains
            it.plan_samples(self.taken + self.spp)
        if hasattr(it, "train") and (self.n_frames == 0 or cumulative):
            # Not the many steps that a first image begins with
            it.train(self.scene, 1 if self.n_frames == 0 else getattr(it, "train_steps", 1), sensor=self.sensor)
        seed = pass_seed(self.seed, STREAM_IMAGE, self.n_frames)
        with placed(it, self.sequence, self.taken):
            image = render_pass(self.scene, it, self.spp, seed, self.sensor)
        self.taken += self.spp
        self.shown += 1
        if cumulative:
            self._film.replace(image, self.spp)
        else:
            self._film.add(image, self.shown if self.learns else 1)
        self.n_frames += 1
        self.seconds += time.perf_counter() - start
        loss = self.loss
        if math.isfinite(loss):
            self.curve.append((self.seconds, "loss", loss))

    def run(self, frames: int) -> np.ndarray:
        """So many frames; returns the picture."""
        for _ in range(frames):
            self.frame()
        return self.image

    @property
    def image(self) -> np.ndarray:
        """The picture so far: linear RGB, float32 of shape (height, width, 3); black before the first frame."""
        if self._film.total is None:
            width, height = self.size
            return np.zeros((height, width, 3), np.float32)
        names = list(self.integrator.aov_names()) if hasattr(self.integrator, "aov_names") else []
        return split_channels(self._film.mean(), names)[0].astype(np.float32)

    def picture(self, exposure: float | None = None) -> np.ndarray:
        """The picture as uint8 sRGB; `exposure` in stops, None: the mean becomes a middle grey."""
        image = self.image
        return exr.to_srgb8(image, exr.automatic_exposure(image) if exposure is None else exposure)

    @property
    def loss(self) -> float:
        """Loss of the latest training step, of the cache or else of the light sampler; NaN where nothing is trained."""
        facts = statistics(self.integrator)
        values = [facts.get(name, math.nan) for name in ("loss", "visibility_loss")]
        return next((float(v) for v in values if math.isfinite(v)), math.nan)

    def measure(self) -> float:
        """Trimmed relMSE of the picture, noted in `curve`; NaN without a reference, or where it shows another view."""
        if self.reference is None or self.moved or not self.shown:
            return math.nan
        error = metrics.relmse_trimmed(self.image, self.reference)
        self.curve.append((self.seconds, "trimmed relMSE", error))
        return error

    # -------------------------------------------------------------------------------------------------------------
    # Changes

    @property
    def moved(self) -> bool:
        """Whether camera or lights are not as they were at the start."""
        return self.camera.moved or any(light.moved for light in self.lights)

    def restart(self) -> None:
        """Begin the picture anew; what was learned stays."""
        self._film = Accumulator()
        self.taken = self.shown = 0
        self.sequence = pass_seed(self.seed, STREAM_IMAGE, self.n_frames)  # of the picture's stratified numbers
        if hasattr(self.integrator, "plan_samples"):
            self.integrator.plan_samples(None)

    def forget(self) -> None:
        """Begin the picture and the learning anew."""
        reset(self.integrator)
        self.n_frames, self.seconds, self.curve = 0, 0.0, []
        self.restart()

    def set(self, name: str, value) -> None:
        """Set a key of the integrator, one of :func:`controls.settings`, and begin the picture anew."""
        known = {s.name: s for s in controls.settings(self.integrator)}
        if name not in known:
            raise ValueError(f"'{name}' cannot be set while rendering; it has: {', '.join(known) or 'none'}")
        own = getattr(self.integrator, name)
        if type(value) is not type(own):
            raise TypeError(f"{name} takes a {type(own).__name__}, got {value!r}")
        setattr(self.integrator, name, value)
        self.restart()

    def turn(self, azimuth: float | None = None, elevation: float | None = None, distance: float | None = None) -> None:
        """Move the camera, see :meth:`controls.Camera.set`, and begin the picture anew."""
        self.camera.set(azimuth, elevation, distance)
        self.restart()

    def light(self, number: int, **changes) -> None:
        """Change a light, see :meth:`controls.Light.set`, and begin the picture anew; the cache adapts."""
        self.lights[number].set(**changes)
        self.restart()

    def home(self) -> None:
        """Camera and lights as at the start."""
        self.camera.set(0.0, 0.0, 1.0)
        for light in self.lights:
            light.set()
        self.restart()


def _integrator(scene, given):
    if given is None:
        given = scene.integrator()
        if given is None:
            raise ValueError("the scene has no integrator; give one, for example 'nirc'")
    if isinstance(given, str):
        given = {"type": given}
    if isinstance(given, dict):
        given = mi.load_dict(given)
    if not isinstance(given, mi.Integrator):
        raise TypeError(f"integrator is a {type(given).__name__}; give a plugin's name, a dictionary or an integrator")
    return given


def _reference(given, size: tuple[int, int]) -> np.ndarray:
    if not hasattr(given, "__array__"):
        return load_reference(given, size).rgb
    rgb = np.asarray(given, np.float64)[..., :3]
    if rgb.shape != (size[1], size[0], 3):
        raise ValueError(f"the reference has shape {rgb.shape}, the picture {(size[1], size[0], 3)}")
    return rgb
