"""What all integrators of this package share: refusals, passes over a film, wrappers, statistics of samples."""

from __future__ import annotations

import weakref
from contextlib import nullcontext

import drjit as dr
import mitsuba as mi

from mi_neural.integrators.checks import (
    check_film,
    check_lights_in_media,
    check_phase_functions,
    check_spp,
    refuse_medium_of,
)
from mi_neural.integrators.keys import Keys
from mi_neural.render import path as paths
from mi_neural.render.binding import BoundScene
from mi_neural.render.film import PASS_SAMPLES, Area, Passes, RaySensor, Samples, coverage, sensor_of
from mi_neural.render.frozen import LOCK, can_freeze_scene, is_recording, undisturbed
from mi_neural.render.media import Media
from mi_neural.render.sampling import PathSampler


class FilmIntegrator(mi.SamplingIntegrator):
    """Base of the integrators that render a film from independent camera samples. Subclasses give `bind`, `estimate`.

    Images are rendered by recorded functions, which are traced once and not for each image: in a scene of a thousand
    shapes tracing takes longer than a sample a pixel.
    """

    #: Extra channels: name -> number of values (3: R, G, B)
    CHANNELS: dict[str, int] = {}  # noqa: RUF012
    #: Most camera samples traced at once.
    PASS_SAMPLES = PASS_SAMPLES
    #: Whether passes may be recorded.
    records = True
    #: Whether participating media are rendered.
    renders_media = False
    #: Bytes that are held at once of each pixel at one sample a pixel.
    PIXEL_BYTES = 64

    def __init__(self, props: Keys):
        super().__init__(props.props)
        self.plugin = props.plugin_name()
        self.max_depth = props.get("max_depth", -1)
        self.rr_depth = min(props.get("rr_depth", 5), paths.NO_LIMIT)
        self.hide = props.get("hide_emitters", False)
        self._check(self.max_depth >= -1, f"max_depth is {self.max_depth}; give -1 (no limit), 0, or a positive number")
        self._check(self.rr_depth >= 1, f"rr_depth is {self.rr_depth}; it must be at least 1")
        self.channels: list[str] = []
        self.media: Media | None = None  # of the bound scene
        self.camera_medium, self.camera_medium_id = None, -1
        self.film_state = _FilmState()

    def _check(self, ok: bool, message: str) -> None:
        if not ok:
            raise ValueError(f"{self.plugin}: {message}")

    def _set_channels(self, text: str) -> None:
        """Write the channels of a comma-separated list."""
        self.channels = [n.strip() for n in text.split(",") if n.strip()]
        for n in self.channels:
            self._check(n in self.CHANNELS, f"unknown channel '{n}'; it has: {', '.join(self.CHANNELS)}")

    def _sensor(self, scene, sensor):
        return sensor_of(scene, sensor, self.plugin)

    @property
    def depth_limit(self) -> int:
        """`max_depth` as a number to compare depths with."""
        return paths.depth_limit(self.max_depth)

    # -------------------------------------------------------------------------------------------------------------
    # To be given by the plugin

    def bind(self, scene, sensor, train: bool = True) -> None:
        """Have all ready for an image of `scene` as `sensor` sees it now. Refuses what cannot be rendered."""
        raise NotImplementedError(f"{type(self).__name__} must define bind()")

    def estimate(self, scene, lights, field, sampler, ray, settings, active):
        """Radiance along camera rays: (L, coverage or mask, {channel: value}).

        `lights` chooses lights (None: the scene itself), `field` is the cache that is queried (None: there is none).
        """
        raise NotImplementedError(f"{type(self).__name__} must define estimate()")

    def bind_media(self, scene, sensor, bound: BoundScene) -> None:
        """Look for media in a scene, that of `bound`, where it is another one, and where the camera is in one."""
        medium, state = sensor.get_medium() if hasattr(sensor, "get_medium") else None, self.film_state
        of_another = state.media_of is None or state.media_of is not bound.parts
        if of_another or (medium is not None and (self.media is None or medium.ptr not in self.media.media)):
            state.media_of = None  # what is refused, or interrupted, is looked at anew the next time
            state.forget_scene()
            self.media = Media.of(scene, [sensor])
            check_phase_functions(scene, sensor, self.plugin)
            state.media_of = bound.parts
        elif self.media is not None and self.media.edited():
            self.film_state.forget_scene()
        if self.media is None:
            return
        if self.bound_lights is not None:
            check_lights_in_media(self.bound_lights, self.plugin)
        self.camera_medium, self.camera_medium_id = medium, -1 if medium is None else medium.ptr

    @property
    def bound_lights(self):
        """What chooses lights now; None: the scene itself."""
        return None

    @property
    def bound_field(self):
        """The cache that is queried now; None: there is none."""
        return None

    @property
    def trains(self) -> bool:
        """Whether the next image trains something."""
        return False

    def settings(self, spp: int) -> tuple:
        """Numbers that may change from image to image, handed on to `estimate` as variables; `spp`: the image's."""
        return ()

    # -------------------------------------------------------------------------------------------------------------
    # Rendering

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """One image: train as the keys say, then render `spp` samples a pixel (0: the sampler's own count)."""
        sensor = self._checked(scene, sensor, spp)
        if is_recording() and self.trains:
            raise RuntimeError(
                f"{self.plugin}: inside a function frozen by dr.freeze nothing can be trained; before it type: "
                "integrator.train(scene, 300), and make the integrator with train_steps=0"
            )
        spp = spp or sensor.sampler().sample_count()
        # A user's recording, too, ends with the process where memory is freed in it
        with LOCK, dr.suspend_grad(), undisturbed() if is_recording() else nullcontext():
            self.bind(scene, sensor)
            block = self._render(scene, sensor, seed, spp)
            film = sensor.film()
            film.prepare(self.aov_names())
            film.put_block(block)
            self.rendered(spp)
            result = film.develop() if develop else mi.TensorXf()
            if evaluate and not is_recording():
                dr.eval(result)
            return result

    @property
    def planned_spp(self) -> int | None:
        """Samples a pixel of the image under way, if it is rendered in several calls."""
        return self.film_state.planned_spp

    def render_block(self, scene, sensor, seed, spp: int):
        """An image block with `spp` samples a pixel of what is bound; nothing is trained."""
        return self._render(scene, sensor, seed, spp)

    def _checked(self, scene, sensor, spp: int):
        """The sensor of an image that can be rendered; ValueError for one that cannot."""
        sensor = self._sensor(scene, sensor)
        if not self.renders_media:
            refuse_medium_of(sensor, self.plugin)
        check_spp(spp, self.plugin)
        check_film(sensor, self.plugin, self.PIXEL_BYTES)
        return sensor

    def rendered(self, spp: int) -> None:
        """Called after each image."""

    def place_samples(self, seed: int | None, first: int = 0) -> None:
        """Say that the next images are parts of one: their samples are those with the numbers from `first` on, and
        their stratified random numbers are those of `seed`, the same in all parts. None: each image is one by itself.

        The mean of the parts then has less noise than that of independent images. The seeds of the parts must differ.
        """
        self.film_state.placed = None if seed is None else (seed, first)

    def _render(self, scene, sensor, seed, spp: int):
        """An image block with `spp` samples a pixel, in passes that fit memory."""
        film, area = sensor.film(), Area.of(sensor)
        film.prepare(self.aov_names())
        block = film.create_block()
        block.set_coalesce(False)
        sequence, first = self.film_state.placed or (seed, 0)
        done = 0
        # A row of pixels at a time if one sample of all is too much, else several samples at a time
        while done < spp:
            n = min(spp - done, max(1, self.PASS_SAMPLES // area.n_pixels))
            whole = n * area.n_pixels <= 2 * self.PASS_SAMPLES
            rows = area.height if whole else max(1, self.PASS_SAMPLES // (n * area.width))
            for y in range(0, area.height, rows):
                sizes = min(rows, area.height - y), n
                part = {"first_row": y, "first_sample": first + done, "sequence": sequence}
                block.put(*self.render_rows(scene, sensor, seed, sizes, **part, total=spp))
            done += n
        return block

    def render_rows(self, scene, sensor, seed, sizes: tuple[int, int], first_row: int = 0, first_sample: int = 0,
                    total: int | None = None, settings: tuple | None = None, sums: bool = False,
                    sequence=None) -> tuple:  # fmt: skip
        """Render ``sizes = (rows, samples a pixel)``, with no training: (places, values) as a film's block takes them.

        `total`: samples a pixel of the whole image. `settings`: in place of the integrator's own. `sums`: add the
        samples of each pixel up, whatever the film's filter. `sequence`: seed of the stratified numbers, if another.
        """
        spp = self.planned_spp or total or sizes[1]
        numbers = (first_sample, sizes[1], first_row, sizes[0], spp)
        sequence = seed if sequence is None else sequence
        samples = Samples(as_seed(seed), as_seed(sequence), *(dr.opaque(mi.UInt32, v) for v in numbers))
        if settings is None:
            settings = self.settings(spp)
        keys = tuple((k, v) for k, v in vars(self).items() if isinstance(v, (bool, int, float, str)))
        place, values, n_bad = self.film_state.passes.run(
            self.film_state.estimate_of(self), {n: self.CHANNELS[n] for n in self.channels}, keys, scene, sensor,
            self.bound_lights, self.bound_field, samples, sizes, [dr.opaque(mi.Float, v) for v in settings],
            record=self.records and not is_recording() and self.film_state.scene_records(scene), sums=sums,
        )  # fmt: skip
        self.film_state.nonfinite.add(n_bad)
        return place, values

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """Radiance along given rays, for integrators that wrap this one (``aov``, ``moment``).

        What has to be trained is trained for these rays, whatever sensor they come from.
        """
        with LOCK:
            if not self.film_state.entered:
                with dr.suspend_grad():
                    self.bind(scene, RaySensor(ray, medium=medium))
                self.rendered(sampler.sample_count())
            settings = [dr.opaque(mi.Float, v) for v in self.settings(self.planned_spp or sampler.sample_count())]
            lane = mi.UInt32(sampler.next_1d() * 2**24)
            own = PathSampler.make(lane, mi.UInt32(sampler.next_1d() * 2**24))
            L, valid, extra = self.estimate(
                scene, self.bound_lights, self.bound_field, own, ray, settings, mi.Bool(active)
            )
        aovs = []
        for name in self.channels:
            aovs += list(extra[name]) if self.CHANNELS[name] == 3 else [extra[name]]
        return L, own.next_1d() < coverage(valid), aovs

    def aov_names(self):
        return [f"{n}.{c}" if self.CHANNELS[n] == 3 else n for n in self.channels
                for c in ("RGB" if self.CHANNELS[n] == 3 else " ")]  # fmt: skip


class Nonfinite:
    """How many samples were not finite. They are read when the number is asked for: no pass is waited for."""

    def __init__(self):
        self.counts: list = []

    def add(self, n_bad) -> None:
        """Take in how many samples of a pass were not finite."""
        if is_recording():
            return
        self.counts.append(n_bad)
        if len(self.counts) > 256:
            self.counts = [sum(self.counts[1:], self.counts[0])]
            dr.eval(self.counts)

    def __int__(self):
        return sum(int(n[0]) for n in self.counts)


class _FilmState:
    """What rendering changes. Apart, because a recorded function is made anew whenever an attribute of the integrator
    that it belongs to changes; this object it takes as a whole."""

    def __init__(self):
        self.passes = Passes()
        self.planned_spp: int | None = None
        self.placed: tuple[int, int] | None = None  # see place_samples()
        self.nonfinite = Nonfinite()
        self.n_bound = self.n_forgotten = 0
        self.media_of: tuple | None = None  # the parts of the scene whose media are bound
        self.said: set[str] = set()
        self.entered = False  # whether Mitsuba's own render() is under way, which calls sample()
        self._estimate = None
        self._records: bool | None = None

    def say_once(self, text: str) -> None:
        """Warn of something that holds from now on."""
        if text not in self.said:
            self.said.add(text)
            mi.Log(mi.LogLevel.Warn, f"mi_neural: {text}")

    def estimate_of(self, integrator):
        """The integrator's `estimate`; held weakly, or a recording would keep the integrator alive."""
        if self._estimate is None:
            held = weakref.ref(integrator)
            self._estimate = lambda *args: held().estimate(*args)
        return self._estimate

    def scene_records(self, scene) -> bool:
        """Whether functions of the bound scene can be recorded; tried once."""
        if self._records is None:
            self._records = can_freeze_scene(scene)
        return self._records

    def forget_scene(self) -> None:
        """Forget what was recorded for the scene that was bound."""
        self.passes.clear()
        self._records = None
        self.n_forgotten += 1

    def statistics(self) -> dict:
        s = {"nonfinite": int(self.nonfinite)}
        if self._records is False:
            s["recorded"] = False
        return s


def as_seed(seed):
    """A seed as a variable, from a number or a variable."""
    return mi.UInt32(seed) if dr.is_jit_v(seed) else dr.opaque(mi.UInt32, int(seed) & 0xFFFFFFFF)


def refuse_gradients(integrator, *_, **__):
    """In the place of ``render_backward`` and ``render_forward`` where there are none."""
    raise RuntimeError(
        f"{integrator.plugin}: it has no gradients; differentiate with Mitsuba's own integrator, for example "
        "mi.render(scene, params, integrator=mi.load_dict({'type': 'prb'}))"
    )
