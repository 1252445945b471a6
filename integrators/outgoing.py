"""What ``nrc`` and ``neural_path`` share: how a cache of outgoing radiance is trained."""

from __future__ import annotations

import math
from dataclasses import replace

import mitsuba as mi

from mi_neural import plan
from mi_neural.caches.field import CacheFileError
from mi_neural.caches.outgoing import OutgoingTraining
from mi_neural.caches.outgoing_field import OutgoingShape
from mi_neural.integrators import gradients
from mi_neural.integrators.common import CacheIntegrator

#: The constants of a training step in the words of the plugins' keys
KEYS = {"world_share": "world_share", "suffix": "train_suffix", "content": "cache_content",
        "n_records": "train_records", "threshold": "spread_threshold", "roughening": "roughening"}  # fmt: skip
#: Rows of these keys, for the docstrings
OUTGOING_KEYS = """
     * - inputs
       - |string|
       - What the network of outgoing radiance gets of a surface beside its position: a list of ``normal``, ``view``,
         ``albedo``, ``roughness``; ``plan``: what the scene needs. A cache that was loaded keeps its own. (Default:
         plan)
     * - train_records
       - |int|
       - Largest number of records of a training frame. If there are more, the last vertices of paths are left out.
         (Default: three times ``train_samples``)
     * - train_suffix
       - |string|
       - Where training paths end: ``spread``, at the second vertex where the path has become wide, or ``full``, at
         ``train_vertices`` whatever the spread. (Default: spread)
     * - world_share
       - |float|
       - Share of the training paths that start at records of earlier frames, so that the cache keeps what leaves the
         view. (Default: 0.25)
     * - unbounded_share
       - |float|
       - Share of the training paths that run on to their natural end, without self-training. Set more where light
         enters by many reflections and the cache starts too dark. (Default: 0.25, of ``neural_path`` with ``denoised``
         0.5. In scenes with media 1, of ``neural_path`` without ``denoised`` 0.25)
     * - roughening
       - |float|
       - Share of each surface's BSDF that becomes Lambertian with each bounce of a training path (none at its first
         vertex, mirrors or glass): less noise in the records, some bias. (Default: 0)"""


class OutgoingIntegrator(CacheIntegrator):
    """Base of the integrators that train a cache of outgoing radiance."""

    CHOOSES_LIGHTS = True
    renders_media = True
    content = "reflected"

    def __init__(self, props):
        super().__init__(props)
        self.spread_threshold = props.get("spread_threshold", 0.01)
        self.unbounded_in_media = props.get("unbounded_share", self.default_unbounded_in_media(props))
        self._check(self.spread_threshold >= 0, f"spread_threshold is {self.spread_threshold}; it must be 0 or more")
        inputs = props.get("inputs", "plan")
        if inputs != "plan":
            names = {n.strip() for n in inputs.split(",") if n.strip()}
            self._check(names <= set(plan.INPUTS), f"inputs is '{inputs}'; give a list of: {', '.join(plan.INPUTS)}")
            self.given |= {name: name in names for name in plan.INPUTS}
        if not math.isfinite(self.spread_threshold):
            self.given["cache"] = False
        # A path of infinite spread threshold never queries the cache; its training paths end by the paper's constant
        self.outgoing_keys = {
            "threshold": self.spread_threshold if math.isfinite(self.spread_threshold) else 0.01,
            "suffix": props.get("train_suffix", "spread"),
            "world_share": props.get("world_share", 0.25),
            "unbounded_share": props.get("unbounded_share", self.default_unbounded(props)),
            "roughening": props.get("roughening", 0.0),
            "learning_rate": self.cache.training.learning_rate,
            "epsilon": self.cache.training.epsilon,
            "n_records": props.get("train_records", None),
        }

    def outgoing_training(self) -> OutgoingTraining:
        """Constants of training of the cache of outgoing radiance; ValueError for keys out of range."""
        try:
            return OutgoingTraining.like(self.cache.training, content=self.content, **self.outgoing_keys)
        except ValueError as e:
            message = str(e)
            for name, key in KEYS.items():
                message = message.replace(f"{name} is", f"{key} is")
            raise ValueError(f"{self.plugin}: {message}") from None

    def bind_media(self, scene, sensor, bound) -> None:
        known = self.walk
        super().bind_media(scene, sensor, bound)
        if self.walk is not known:
            share = self.outgoing_keys["unbounded_share"] if self.media is None else self.unbounded_in_media
            self.cache.training = replace(self.cache.training, unbounded_share=share)

    def check_media(self) -> None:
        self._check(self.media is None or self.cache.training.roughening == 0,
                    "roughening works in scenes without participating media; leave it out")  # fmt: skip

    def shape_keys(self, props) -> dict:
        return {"width": OutgoingShape.width}

    def default_paths(self) -> int:
        return OutgoingTraining.usual_paths()

    def default_unbounded(self, props) -> float:
        """Share of training paths without an end in the cache where no key says it."""
        return OutgoingTraining.unbounded_share

    def default_unbounded_in_media(self, props) -> float:
        """That share in scenes with participating media. With all of them denoised images of 8 samples by ``nrc`` have
        0.83 (a cloud), 0.77 (a courtyard) and 0.70 (wax) of the squared error with a quarter, after 150 steps."""
        return 1.0

    def default_epsilon(self) -> float:
        return OutgoingTraining.epsilon

    def default_rate(self, blend: str) -> float:
        return OutgoingTraining.learning_rate if blend == "ema" else super().default_rate(blend)

    @property
    def needs_cache(self) -> bool:
        return super().needs_cache and math.isfinite(self.spread_threshold)

    # -------------------------------------------------------------------------------------------------------------

    def incident_radiance(self, scene, lights, field, path, found, after, sampler):
        return gradients.by_outgoing_cache(self, scene, lights, field, self.content, after, sampler)

    PROBES = 1

    def probe(self, field, x, sampler):
        normal, w = (mi.warp.square_to_uniform_sphere(sampler.next_2d()) for _ in range(2))
        return field.query(x, normal, w, mi.Color3f(sampler.next_1d()), sampler.next_1d())

    def file_facts(self) -> dict:
        return {**super().file_facts(), "content": self.content}

    def check_file(self, path, header: dict) -> None:
        if header.get("content", self.content) != self.content:
            raise CacheFileError(f"'{path}' holds {header['content']} light; set cache_content to {header['content']}")

