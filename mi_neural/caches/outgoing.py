"""NRC: the neural radiance cache of what surfaces send out (Müller et al. 2021), and how it is trained.

The cache learns ``L(x, ω)``: the radiance that leaves the surface at x towards ω, whatever of it the caller puts into
the targets (with or without emission, with or without direct light: the same at training and at queries).
:class:`~mi_neural.caches.outgoing_field.OutgoingField` is the function that is learned, :class:`OutgoingCache` trains
it in a scene. For renderers of your own: :class:`~mi_neural.caches.radiance_cache.RadianceCache`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render.kernels import on_gpu
from ..render.sampling import PathSampler
from ..render.surface import scene_is_glossy
from ..render.walk import SURFACES, SurfaceWalk
from . import encoding, loss
from .blend import OutgoingBlend
from .incident import IncidentCache, Training, scale_of
from .outgoing_field import OutgoingField, OutgoingShape, reflectance
from .places import N_PLACES
from .records import packed
from .reliability import Reliability
from .trainer import found
from .training_paths import CONTENTS, Suffixes, trace_training_paths
from .voxels import Ages

#: The learning rate of this network over that of the incident cache, trained on the same paths (manual, measured)
RATE = 6.0
#: Training paths on a GPU over those on a CPU.
GPU_PATHS = 4


@dataclass(frozen=True)
class OutgoingTraining(Training):
    """Constants of one training step; those of :class:`~mi_neural.caches.incident.Training` but `loss`, and

    n_paths           training paths. In equal time half as many at twice the rate learn as well or better (manual,
                      measured)
    epsilon           of the relative loss, over the squared scale. Relative squared error of the cache seen directly,
                      300 steps in a stairwell: 0.070 with 0.01, 0.069 with 0.1, 0.066 with 1
    n_records         places for records in a step; more are left out
    suffix, threshold, world_share, roughening, content
                      see :class:`~mi_neural.caches.training_paths.Suffixes`
    unbounded_share   share of the paths that run on without self-training (Müller et al. 2021: 1/16). In a room lit
                      through a door ajar the image had 0.96 and 0.97 of its light after 100 and 300 steps with 1/16,
                      0.99 and 1.00 with 1/4; in a stairwell 1.00 with either. A step takes 1.1 to 1.2 times as long
    """

    n_paths: int = 2048
    learning_rate: float = RATE * Training.learning_rate
    epsilon: float = 1.0
    n_records: int | None = None
    suffix: str = "spread"
    threshold: float = 0.01
    unbounded_share: float = 1 / 4
    world_share: float = 0.25
    roughening: float = 0.0
    content: str = "reflected"

    def __post_init__(self):
        super().__post_init__()
        for name, choices in (("suffix", ("spread", "full")), ("content", CONTENTS)):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} is '{getattr(self, name)}'; give one of: {', '.join(choices)}")
        for name in ("unbounded_share", "world_share", "roughening"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must lie in [0, 1]")
        if self.n_records is not None and self.n_records < 1:
            raise ValueError(f"n_records is {self.n_records}; it must be at least 1")
        if not self.threshold >= 0:
            raise ValueError(f"threshold is {self.threshold}; it must be 0 or more")

    @classmethod
    def usual_paths(cls) -> int:
        """`n_paths` where none were chosen. A GPU has room for `GPU_PATHS` times as many in hardly more time (manual,
        speed)."""
        return cls.n_paths * (GPU_PATHS if on_gpu() else 1)

    @classmethod
    def like(cls, shared: Training, **chosen) -> OutgoingTraining:
        """The constants that incident and outgoing training have in common, `RATE` times its learning rate, and
        `chosen` others."""
        common = {"n_paths": shared.n_paths, "n_vertices": shared.n_vertices, "ema_decay": shared.ema_decay,
                  "last_rate": shared.last_rate, "learning_rate": RATE * shared.learning_rate,
                  "ema_debiased": shared.ema_debiased}  # fmt: skip
        return cls(**(common | chosen))

    def decay(self, step):
        # The field frees its average of the bias by itself
        return self.ema_decay if self.ema_debiased else super().decay(step)

    def paths(self, probe: bool = False, twins: bool = False) -> Suffixes:
        """How training paths run; those of the `probe` end in nothing, for want of a cache."""
        return Suffixes(
            self.n_paths, self.n_vertices, "full" if probe else self.suffix, self.threshold,
            0 if probe else round(self.n_paths * self.unbounded_share), self.world_share, self.roughening, self.content,
            twins,
        )  # fmt: skip

    @property
    def capacity(self) -> int:
        """Places for the records of a step. Where they do not suffice, the last vertices of long paths have none."""
        most = self.n_paths * (self.n_vertices - 1)
        return min(most, self.n_records or (3 * self.n_paths if self.suffix == "spread" else most))


def training_paths(
    scene, sensor, field: OutgoingField | None, training: OutgoingTraining, seed, lights, glossy: bool,
    twins: bool = False, walk: SurfaceWalk = SURFACES,
):  # fmt: skip
    """Fresh training paths, targets ending in the averaged cache (in nothing without a field); see
    :func:`~mi_neural.caches.training_paths.trace_training_paths`."""
    lane = dr.arange(mi.UInt32, training.n_paths)
    sampler = PathSampler.make(lane, seed, index=lane, scramble=seed)
    plan = training.paths(field is None, twins)
    if field is None:
        return trace_training_paths(scene, sensor, sampler, plan, None, lights, None, glossy, walk)

    def query(path, active, sampler):
        return field.query(*walk.surface(path, active, glossy).inputs()), sampler

    # Close before the place, where hardly anything can lie between
    known = field.places
    places = known.position, known.view, 1e-3 * dr.norm(1 / field.box_inv_extent), known.inside
    return trace_training_paths(scene, sensor, sampler, plan, query, lights, places, glossy, walk)


def fitted(records, training: OutgoingTraining):
    """The valid ones of evaluated `records` in as many places as a step has for them."""
    return packed(records, training.capacity) if training.capacity < dr.width(records.valid) else records


def trace_outgoing(
    scene, sensor, field: OutgoingField | None, training: OutgoingTraining, seed, lights, glossy: bool,
    walk: SurfaceWalk = SURFACES,
):  # fmt: skip
    """Fresh training records, and how many were left out because their targets were not finite."""
    traced = training_paths(scene, sensor, field, training, seed, lights, glossy, walk=walk)
    records, n_bad = traced.outgoing, traced.n_bad[0]
    if field is not None:
        dr.eval(records, n_bad)
        records = fitted(records, training)
    return records, n_bad


def _reaching(low, high, scene_low, scene_high) -> tuple:
    """The box of what a camera's paths met, grown by its longest side towards what else is in the scene: training
    paths start there too, but what is far away must not take the grid's cells."""
    low, high = np.array(low), np.array(high)
    reach = (high - low).max()
    if not (np.isfinite(scene_low).all() and np.isfinite(scene_high).all()):
        return low, high
    return np.minimum(low, np.maximum(scene_low, low - reach)), np.maximum(high, np.minimum(scene_high, high + reach))


class OutgoingCache(IncidentCache):
    """A field of outgoing radiance together with its training. In all but what it learns an `IncidentCache`."""

    FIELD, BLEND = OutgoingField, OutgoingBlend

    def __init__(
        self, training: OutgoingTraining | None = None, shape: OutgoingShape | None = None, seed: int = 0, *,
        blend: str = "ema", reliability: Reliability | None = None,
    ):  # fmt: skip
        super().__init__(
            training or OutgoingTraining(), shape or OutgoingShape(), seed, blend=blend, reliability=reliability
        )

    def probe(self, scene, sensor, lights, seed):
        records, _ = trace_outgoing(scene, sensor, None, self.training, seed, lights, False, self.walk)
        target = records.target / reflectance(records.surface.albedo)
        return records.surface.position, loss.luminance(target), records.valid

    def frame(self, scene, sensor, lights, cache, ages, seed, rate_factor):
        blend = cache if isinstance(cache, OutgoingBlend) else None
        field = blend.field if blend else cache
        with dr.suspend_grad():
            records, n_bad = trace_outgoing(
                scene, sensor, field, self.training, seed, lights, scene_is_glossy(scene), self.walk
            )
            n_valid = dr.count(records.valid)
            dr.eval(records, n_bad, n_valid)
            learning_rate, decay = self.pace(ages, records.surface.position, records.valid, rate_factor, field)
            self.note(field, records, seed, decay)

        def compare(y, current, usable):
            surface = records.surface
            averaged = field.query(*surface.inputs()) / reflectance(surface.albedo)
            dr.eval(averaged)
            blend.observe_surfaces(surface.position, surface.normal, usable, y, current, averaged)

        value, mean_target, mean_prediction, more = field.learn(
            *records.surface.inputs(), records.target, records.valid, learning_rate, decay, self.training.epsilon,
            compare if blend else None,
        )  # fmt: skip
        value = dr.select(n_valid > 0, value, 0)  # nothing to learn is no divergence
        sigma = mi.Float(0)
        if blend:
            with dr.suspend_grad():
                blend.refresh()
                sigma = blend.mean_sigma()
        return found(value, ages, mean_target, mean_prediction, n_valid, n_bad + more, sigma)

    def forget_media(self) -> None:
        if self.field is not None:
            self.field.places.forget_media()

    def note(self, field: OutgoingField, records, seed, decay) -> None:
        """Keep where the records of a step lie."""
        field.count(records.surface.position, records.valid, decay)
        if self.training.world_share > 0:
            sampler = PathSampler.make(dr.arange(mi.UInt32, N_PLACES), seed + 0x9E3779B9)
            surface = records.surface
            field.places.remember(surface.position, surface.view, records.valid, sampler, records.inside)

    def start(self, scene, sensor, lights=None) -> None:
        """Measure where light is asked for and how bright it is, and make the field; no training."""
        with dr.suspend_grad():
            seed = mi.UInt32(self.random_seed(0xFFFFFF))
            measured = self.call("probe", sensor, scene, sensor, lights, seed)
            points, target, valid = (np.array(v) for v in measured)
        box = scene.bbox()
        whole = np.array(box.min).ravel(), np.array(box.max).ravel()
        low, high = encoding.record_box(points.T[valid], *whole)
        if self.training.world_share > 0 and not self.walk.in_media:
            low, high = _reaching(low, high, *whole)
        scale = scale_of(target[valid])
        self.field, self.ages = OutgoingField(low, high, self.shape, scale=scale, seed=self.seed), Ages(low, high)
        dr.eval(self.field)
