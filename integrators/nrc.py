"""``nrc``: paths that end in a neural outgoing radiance cache."""

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from mi_neural import plan
from mi_neural.caches.blend import OutgoingBlend, sigma_channels
from mi_neural.caches.field import CacheFileError
from mi_neural.caches.outgoing import RATE, OutgoingCache, OutgoingShape, OutgoingTraining
from mi_neural.caches.pair import PairCache
from mi_neural.integrators import automatic
from mi_neural.integrators.automatic import AUTO
from mi_neural.integrators.common import CacheIntegrator
from mi_neural.integrators.keys import SHARED_KEYS
from mi_neural.render import prefix, vertex
from mi_neural.render.surface import scene_is_glossy, surface_of

#: Where paths end
TERMINATIONS = ("spread", "auto")
#: The constants of a training step in the words of the plugin's keys
KEYS = {"world_share": "world_share", "suffix": "train_suffix", "content": "cache_content",
        "threshold": "spread_threshold", "roughening": "roughening"}  # fmt: skip


class NRCIntegrator(CacheIntegrator):
    CHOOSES_LIGHTS = True

    def __init__(self, props):
        super().__init__(props)
        self.spread_threshold = props.get("spread_threshold", 0.01)
        self.content = props.get("cache_content", "reflected")
        self.termination = props.get("termination", "spread")
        self._check(self.termination in TERMINATIONS,
                    f"termination is '{self.termination}'; give one of: {', '.join(TERMINATIONS)}")  # fmt: skip
        if self.termination == "auto":
            self._check(self.content == "reflected", "termination 'auto' needs cache_content 'reflected'")
        self._check(self.spread_threshold >= 0, f"spread_threshold is {self.spread_threshold}; it must be 0 or more")
        told = props.get("inputs", "plan")
        if told != "plan":
            names = {n.strip() for n in told.split(",") if n.strip()}
            self._check(names <= set(plan.INPUTS), f"inputs is '{told}'; give a list of: {', '.join(plan.INPUTS)}")
            self.given |= {name: name in names for name in plan.INPUTS}
        if not math.isfinite(self.spread_threshold):
            self.given["cache"] = False
        # A path of infinite spread threshold never asks the cache; its training paths end by the paper's constant
        chosen = {
            "threshold": self.spread_threshold if math.isfinite(self.spread_threshold) else 0.01,
            "content": self.content,
            "suffix": props.get("train_suffix", "spread"),
            "world_share": props.get("world_share", 0.25),
            "unbounded_share": props.get("unbounded_share", OutgoingTraining.unbounded_share),
            "roughening": props.get("roughening", 0.0),
            "learning_rate": self.cache.training.learning_rate,
        }
        shared, sizes = self.cache.training, self.cache.shape
        try:
            training = OutgoingTraining.like(shared, **chosen)
        except ValueError as e:
            message = str(e)
            for name, key in KEYS.items():
                message = message.replace(f"{name} is", f"{key} is")
            raise ValueError(f"{self.plugin}: {message}") from None
        if self.termination == "auto":
            automatic.check(self)
            incident = replace(shared, learning_rate=shared.learning_rate / RATE)
            self.cache = PairCache(training, incident, sizes, self.seed)
        else:
            self.cache = OutgoingCache(
                training, OutgoingShape.like(sizes), self.seed, blend=self.cache.blend,
                reliability=self.cache.reliability,
            )  # fmt: skip

    def default_blend(self, props) -> str:
        blends = self.plan_mode == "everything" and props.get("termination", "spread") != "auto"
        return "reliability" if blends else "ema"

    def default_rate(self, blend: str) -> float:
        return OutgoingTraining.learning_rate if blend == "ema" else super().default_rate(blend)

    @property
    def caches(self) -> tuple[str, ...]:
        return ("outgoing", "incident") if self.termination == "auto" else ("outgoing",)

    def settings(self, spp: int) -> tuple:
        return (float(spp),)

    @property
    def needs_cache(self) -> bool:
        return super().needs_cache and math.isfinite(self.spread_threshold)

    @property
    def queries_per_sample(self) -> float:
        if not self.needs_cache:
            return 0.0
        return automatic.QUERIES if self.termination == "auto" else 1.0

    # -------------------------------------------------------------------------------------------------------------

    def estimate(self, scene, lights, field, sampler, ray, settings, active):
        """E[L] = path tracing up to the vertex where the spread exceeds that of the pixel, and the cache there."""
        if self.termination == "auto":
            return automatic.estimate(self, scene, lights, field, sampler, ray, settings[0], active)
        cached, glossy = self.needs_cache and field is not None, scene_is_glossy(scene)

        def stop(si, spread, smooth, first, sampler):
            wide = smooth & spread.exceeds(self.spread_threshold)
            never = mi.Bool(False)
            return mi.Float(0), *((wide, never) if self.content == "reflected" else (never, wide)), sampler

        looks = cached and bool({"cache", "density"} & set(self.channels))
        end, sampler = prefix.trace(
            self, scene, lights, sampler, ray, active, stop if cached else None, glossy, looks
        )
        path, cache = end.path, mi.Color3f(0)
        if cached:
            surface = surface_of(path.si, path.si.bsdf(path.ray), end.queried, glossy)
            cache = dr.select(end.queried, path.β * field.query(*surface.inputs()), 0)
        channels = {"traced": path.L, "cached": cache, "depth": dr.select(path.valid, mi.Float(path.depth), 0)}
        shown = sigma_channels(field if cached else None, path.si.p, vertex.facing(path.si))
        channels |= {k: dr.select(end.queried, v, 0) for k, v in shown.items()}
        channels |= {"share": mi.Float(0), "cache": mi.Color3f(0), "density": mi.Float(0)}
        if looks:
            seen = dr.max(end.β_first) > 0
            channels["cache"] = dr.select(seen, end.β_first * field.query(*end.first.inputs()), 0)
            plain = field.field if isinstance(field, OutgoingBlend) else field
            channels["density"] = dr.select(seen, plain.density_at(end.first.position), 0)
        return path.L + cache, path.valid, channels

    # -------------------------------------------------------------------------------------------------------------

    PROBES = 1

    def probe(self, field, x, sampler):
        field = getattr(field, "outgoing", field)
        normal, w = (mi.warp.square_to_uniform_sphere(sampler.next_2d()) for _ in range(2))
        return field.query(x, normal, w, mi.Color3f(sampler.next_1d()), sampler.next_1d())

    def file_facts(self) -> dict:
        return {**super().file_facts(), "content": self.content}

    def check_file(self, path, header: dict) -> None:
        if header.get("content", self.content) != self.content:
            raise CacheFileError(f"'{path}' holds {header['content']} light; set cache_content to {header['content']}")

    def to_string(self):
        return (
            f"NRCIntegrator[\n  spread_threshold = {self.spread_threshold},\n  cache_content = {self.content},\n"
            f"  max_depth = {self.max_depth},\n"
            f"  training = {self.cache.training},\n  network = {self.cache.shape},\n"
            f"  frames trained = {self.cache.steps},\n  plan = {self.state.plan or self.plan_mode}\n]"
        )


NRCIntegrator.CHANNELS = {
    "traced": 3, "cached": 3, "cache": 3, "depth": 1, "share": 1, "density": 1, "sigma": 1, "preference": 1
}  # fmt: skip
NRCIntegrator.__doc__ = (
    r"""
    .. _integrator-nrc:

    Neural radiance cache (:monosp:`nrc`)
    -------------------------------------

    Estimates all light with little noise and a small bias: paths are traced as in ``path`` until they have become so
    wide that detail would not be seen, and end there in a network trained while rendering, which knows the outgoing
    radiance :math:`L(x, \omega)` (Müller et al. 2021, "Real-time Neural Radiance Caching for Path Tracing"):

    .. math:: L_o = L_e + \sum_{i<n} \beta_i L_{direct}(x_i) + \beta_n L_{cache}(x_n, \omega_n).

    n is the first vertex with :math:`a > c\,a_0` (sec. 3.4), where
    :math:`\sqrt{a} = \sum_{i=2}^n \sqrt{|x_{i-1}-x_i|^2 / (p(\omega_i) |\cos\theta_i|)}` and
    :math:`a_0 = |x_0-x_1|^2 / (4\pi |\cos\theta_1|)`. Mirrors and glass are followed: they add nothing to a, the first
    vertex is the one seen through them, and none of them is a terminal vertex. :math:`E[L_o]` is the path-traced
    radiance if the cache is exact.

    What the cache holds: the light that a surface reflects, direct light included (``cache_content``). What it does
    not: emission, which is counted at the vertex before, with its MIS weight, and so never twice.

    Training paths begin as those of pixels do, or at places that earlier ones have met; they go on beyond the terminal
    vertex until they have become as wide once more, where the cache completes them (self-training), and each vertex is
    a record. One in 4 runs on without (``unbounded_share``). The reflectance is factored out of the records and
    multiplied back.

    .. pluginparameters::

     * - spread_threshold
       - |float|
       - The constant c: 0 asks the cache at the first surface that is not a mirror, infinity never (``nrc`` is a path
         tracer). An SDK defines :math:`a_0` as :math:`4\pi |x_0-x_1|^2 / |\cos\theta_1|`, 158 times as large: give
         158 times its constant. (Default: 0.01)
     * - termination
       - |string|
       - Where paths end. ``spread``: as above. ``auto``: by what was measured of both caches, see below. (Default:
         spread)
     * - cache_content
       - |string|
       - What the cache holds. ``reflected``: all reflected light. ``indirect``: without direct light, which is traced
         at the terminal vertex too: less bias, for one more bounce. (Default: reflected)
     * - inputs
       - |string|
       - What the network is told of a surface beside its position: a list of ``normal``, ``view``, ``albedo``,
         ``roughness``; ``plan``: what the scene needs. A cache that was loaded keeps its own. (Default: plan)
     * - train_suffix
       - |string|
       - Where training paths end: ``spread``, as above, or ``full``, at ``train_vertices`` whatever the spread.
         (Default: spread)
     * - world_share
       - |float|
       - Share of the training paths that start where records of all earlier frames lay, so that what leaves the view
         is not forgotten. (Default: 0.25)
     * - unbounded_share
       - |float|
       - Share of the training paths that run on to their natural end, without self-training: more where light enters
         by many reflections, and the cache starts too dark. (Default: 0.25)
     * - roughening
       - |float|
       - Share of each surface's BSDF that becomes Lambertian with each bounce of a training path (none at its first
         vertex, mirrors or glass): less noise in the records, some bias. (Default: 0)"""
    + SHARED_KEYS
    + AUTO
    + r"""
    The incident cache is asked in 4 directions; ``cache_content`` must be ``reflected``.

    Channels: ``traced``, ``cached`` (RGB each; with visible emission in ``traced`` they sum to the image), ``cache``
    (RGB: the cache seen directly at the first vertex), ``depth`` (segments up to the end of the path: a heat map of
    where paths end), ``share`` (weight of the cache at the first vertex, with ``auto``), ``density`` (training records
    per frame near the first vertex, in a cell of 1/32 of the box), ``sigma`` and ``preference`` (of ``blend``: weight
    of the network being trained where the cache was asked, and 1 where it exceeds 1/2). ``statistics()["loss"]`` is the
    loss of the latest training frame, ``cache.history`` holds those of all.

    *Works with* all surfaces and emitters of Mitsuba, RGB variants ``llvm_ad_rgb`` and ``cuda_ad_rgb``. *Leaves out*
    participating media (use ``volpath``), polarization, spectral rendering, and a limit to the number of bounces inside
    the cache (use ``path``). Sharp reflections seen by way of a rough surface are blurred.

    Errors: ``ValueError`` for a key out of range, a scene without emitters, sensors or with media;
    :class:`~mi_neural.caches.field.CacheFileError` for cache files.

    .. tabs::
        .. code-tab:: xml

            <integrator type="nrc">
                <float name="spread_threshold" value="0.01"/>
            </integrator>

        .. code-tab:: python

            integrator = mi.load_dict({"type": "nrc", "channels": "cache, depth"})
            integrator.train(scene, 300)               # optional: the first image trains by itself
            image = mi.render(scene, integrator=integrator, spp=16)
    """
)
mi.register_integrator("nrc", lambda props: NRCIntegrator(props))
