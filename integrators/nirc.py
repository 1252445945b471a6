"""``nirc``: paths that end in a neural incident radiance cache."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural import plan
from mi_neural.caches.blend import sigma_channels
from mi_neural.caches.incident import IncidentCache
from mi_neural.caches.material import material_at
from mi_neural.caches.outgoing import OutgoingCache
from mi_neural.caches.sh_grid import HarmonicCache
from mi_neural.caches.spatial_hash import SpatialHashCache
from mi_neural.estimators import spread
from mi_neural.estimators.spread import SHARP_PDF
from mi_neural.integrators import stopping
from mi_neural.integrators.blending import Blending, blending_of
from mi_neural.integrators.incident import INCIDENT_KEYS, INCIDENT_PRESETS, IncidentIntegrator
from mi_neural.integrators.keys import BLEND_KEYS, SHARED_KEYS, older_name, register
from mi_neural.integrators.planning import SIZES
from mi_neural.render import path as paths
from mi_neural.render import vertex
from mi_neural.render.film import film_rays
from mi_neural.render.sampling import PathSampler

#: Caches of incident radiance without a network
CONTROLS = {"spatial_hash": SpatialHashCache, "sh_grid": HarmonicCache}
#: Constant c of the spread test of paths that stop in the cache.
WIDE = 1.0
TERMINATIONS = ("adaptive", "primary", "spread", "balanced", "balanced_shares")
#: Dimensions of the stratified numbers of cache samples
EXTRA, EXTRA_LOBE = range(paths.FREE, paths.FREE + 2)


@dataclass
class Traced:
    """Sums over the traced samples of a first vertex: direct light, what is gathered beyond the cache's predictions,
    rays beyond those of direct light, and pixels covered."""

    direct: mi.Color3f
    residual: mi.Color3f
    n_rays: mi.UInt32
    covered: mi.Float


class NIRCIntegrator(IncidentIntegrator):
    CHOOSES_LIGHTS = True
    renders_media = True
    ENDS_AT_WINDOWS = True

    def __init__(self, props):
        super().__init__(props)
        self.cache_samples = props.get("cache_samples", 4)
        self.light_samples = props.get("light_samples", -1)
        self.termination = props.get("termination", "adaptive")
        self.spread_threshold = props.get("spread_threshold", 0.01)
        self.gather_half = props.get("gather_half", 4.0)
        self.denoised = props.get("denoised", False)
        self.path_threshold = self.spread_threshold if "spread_threshold" in props else WIDE
        self._check(self.cache_samples >= 0, f"cache_samples is {self.cache_samples}; give 0 (no cache) or more")
        self._check(self.light_samples == -1 or self.light_samples >= 1,
                    f"light_samples is {self.light_samples}; give -1 (chosen by noise) or at least 1")  # fmt: skip
        self._check(self.gather_half >= 0, f"gather_half is {self.gather_half}; it must be 0 or more")
        self._check(self.termination in TERMINATIONS,
                    f"termination is '{self.termination}'; give one of: {', '.join(TERMINATIONS)}")  # fmt: skip
        self._check(self.spread_threshold >= 0, f"spread_threshold is {self.spread_threshold}; it must be 0 or more")
        self._choose_cache(props.get("cache", "plan"))
        if self.cache_samples == 0:
            self.given["cache"] = False
        if self.light_samples > 0:
            self.given["light_samples"] = self.light_samples

    def _choose_cache(self, kind: str) -> None:
        """Put another cache of incident radiance in the place of the network, if a key says so."""
        self._check(kind in ("plan", "network", *CONTROLS),
                    f"cache is '{kind}'; give one of: plan, network, {', '.join(CONTROLS)}")  # fmt: skip
        if kind != "plan":
            self.given["cache"] = kind
        if kind not in CONTROLS:
            return
        self._check(self.preset == "measured", f"cache is '{kind}', but the preset '{self.preset}' is of the network; "
                    "leave one of the two out")  # fmt: skip
        control, known = CONTROLS[kind], self.cache
        self._check(kind != "spatial_hash" or known.blend == "ema",
                    f"blend is '{known.blend}'; a spatial hash has one set of means and needs 'ema'")  # fmt: skip
        sizes = {name: self.given[key] for key, name in SIZES.items() if key in self.given}
        unknown = [key for key, name in SIZES.items() if name in sizes and not hasattr(control.SHAPE, name)]
        self._check(not unknown, f"{', '.join(unknown)} is a size of the network; cache is '{kind}'")
        try:
            shape = control.SHAPE(**sizes)
        except ValueError as e:
            raise ValueError(f"{self.plugin}: {e}") from None
        self.cache = control(known.training, shape, self.seed, blend=known.blend, reliability=known.reliability)

    def blending(self, props) -> Blending:
        return blending_of(props, "reliability" if self.plan_mode == "everything" else "ema")

    def use_cache(self, cache) -> None:
        """Train and ask `cache` from now on; it starts anew, with the constants of training that it was made with.

        An :class:`~mi_neural.caches.incident.IncidentCache`, or one of a class of your own that derives from it, see
        :mod:`mi_neural.caches.arrays`. Raises ValueError for another.
        """
        fits = isinstance(cache, IncidentCache) and not isinstance(cache, OutgoingCache)
        self._check(fits, f"use_cache() takes an IncidentCache or a class of your own derived from it; got "
                    f"{type(cache).__name__}")  # fmt: skip
        self.cache = cache
        self.cache.walk = self.walk
        self.given["cache"] = type(cache).__name__
        self.state.plan = None
        self.film_state.passes.clear()
        self.reset()

    @property
    def needs_cache(self) -> bool:
        return super().needs_cache and self.cache_samples > 0

    @property
    def one_path(self) -> bool:
        """Whether a camera sample is a path that stops in the cache."""
        return self.termination == "balanced" or (self.termination == "adaptive" and self.denoised)

    @property
    def queries_per_sample(self) -> float:
        if not self.needs_cache:
            return 0.0
        return 1.0 if self.one_path else max(self.cache_samples, self.n_light)

    @property
    def n_light(self) -> int:
        """Emitter and traced BSDF samples per camera sample: as set, or as :meth:`measure_scene` found."""
        return self.light_samples if self.light_samples > 0 else self.state.measured.get("light_samples", 1)

    def measure_scene(self, scene, sensor) -> None:
        """Choose `light_samples` by the noise of direct light at the first vertex, measured once per scene; a path that
        stops has one at each vertex."""
        if self.light_samples > 0 or self.one_path:
            return
        n, lights = 2**14, self.state.lights
        lane = dr.arange(mi.UInt32, n)
        sampler = PathSampler.make(lane, mi.UInt32(0xD1DEC7), index=lane, scramble=mi.UInt32(1))
        ray = film_rays(sensor, sampler.stratified_2d(0), sampler)
        path, sampler = self.walk.first_vertex(self, scene, ray, sampler, mi.Bool(True))

        def once(k, mean, square, sampler):
            found, sampler = self.walk.bounce(self, scene, lights, path, sampler)
            direct = dr.mean(vertex.finite(path.β * found.direct, path.active))
            return k + 1, mean + 0.25 * direct, square + 0.25 * dr.square(direct), sampler

        _, mean, square, sampler = dr.while_loop(
            (mi.UInt32(0), mi.Float(0), mi.Float(0), sampler), lambda k, *_: k < 4, once
        )
        dr.eval(mean, square, path.L)  # one kernel, not one for each
        variance = np.array(dr.maximum(square - dr.square(mean), 0)) * (4 / 3)
        # Relative to the brightness of the place, the scene's mean being its floor
        level = float(np.mean(np.array(mean + dr.mean(path.L))))
        if self.cache.field is not None:
            level += float(self.cache.field.scale[0])
        noise = np.sort(variance / (np.array(mean) ** 2 + 0.25 * level**2 + 1e-30))[: int(0.999 * n)].mean()
        chosen = plan.light_samples(float(noise))
        self.state.measured |= {"direct_noise": float(noise), "light_samples": chosen.value}
        if self.state.plan is not None:
            self.state.plan.decisions["light_samples"] = chosen

    def settings(self, spp: int) -> tuple:
        """The share of far light that is gathered: with ``adaptive`` 0 for a single sample a pixel, 1/2 after
        `gather_half` more. Of paths that stop the constant c of the spread test, which grows with the samples, so that
        E tends to that of path tracing."""
        if self.one_path:
            return (spread.grown(self.path_threshold, spp),)
        if self.termination != "adaptive":
            return ({"spread": 1.0}.get(self.termination, 0.0),)
        more = max(spp - 1, 0)
        return (more / (more + self.gather_half) if more else 0.0,)

    # -------------------------------------------------------------------------------------------------------------

    def estimate(self, scene, lights, field, sampler, ray, settings, active):
        """E[L] = Le + direct + ∫ f [L_cache + u (L_gather - L_cache)] cos dω, with the share u(ω) of `gather_share`, or
        that of a path that stops in the cache."""
        (setting,) = settings
        path, sampler = self.walk.first_vertex(self, scene, ray, sampler, active)
        active, n_light = path.active, self.n_light
        bsdf = path.si.bsdf(path.ray)
        if self.one_path and self.cached(field):
            by_chance = self.termination == "balanced"
            rule = stopping.ByChance(self.cache_samples) if by_chance else stopping.WhereWide(setting)
            return stopping.estimate(self, scene, lights, field, path, sampler, rule)
        features = None
        if self.cached(field):
            features = field.encode(*self.walk.place(path), **material_at(field, self.walk, path, bsdf, active))

        # ---------------- Samples with a ray: direct light, and what the ray meets ----------------
        traced, cache, sampler = self.traced_samples(scene, lights, field, features, path, bsdf, setting, sampler)

        # -------------------------- Samples of the cache without a ray ----------------------------
        if features is not None:
            more, sampler = self.cache_samples_only(field, features, path, bsdf, sampler)
            cache = (cache + more) / max(self.cache_samples, n_light)
        direct, residual = traced.direct / n_light, traced.residual / n_light
        L = path.L + dr.select(active, path.β * (direct + cache + residual), 0)
        coverage = dr.select(active, traced.covered / n_light, dr.select(path.valid, 1.0, 0.0))

        channels = {"direct": path.β * direct, "cache": path.β * cache, "residual": path.β * residual}
        channels |= {"depth": path.depth + mi.Float(traced.n_rays) / n_light}
        channels |= sigma_channels(field if features is not None else None, *self.walk.place(path))
        return L, coverage, {k: dr.select(active, v, 0) for k, v in channels.items()}

    def cached(self, field) -> bool:
        """Whether the cache is queried at all."""
        return self.needs_cache and field is not None

    def traced_samples(self, scene, lights, field, features, path, bsdf, mixture, sampler):
        """Sums over `n_light` BSDF samples that are traced: (:class:`Traced`, the cache's predictions, sampler)."""
        walk, active, n_light = self.walk, path.active, self.n_light
        here = replace(path, L=mi.Color3f(0), β=mi.Color3f(1), η=mi.Float(1))
        a_0 = walk.camera_spread(path)
        # Of these samples, so many gather what lies far: as few as the share allows, to save the others their rays
        n_gather = dr.clip(dr.ceil(mixture * n_light), 1, n_light)

        def sample(i, traced, cache, sampler):
            numbers = paths.stratified(sampler, n_light, i)
            found, sampler = walk.bounce(self, scene, lights, here, sampler, numbers, bsdf)
            Li_cache = mi.Color3f(0)
            if features is not None:
                smooth = found.traced & ~found.delta
                Li_cache = dr.select(smooth, found.turn * field.query(features, found.ray.d), 0)

            # ------------------ Reflection by what the ray met --------------------
            width = walk.segment_spread(here, found)
            far = dr.select(mi.Float(i) < n_gather, mixture * n_light / n_gather, 0)
            share = mi.Float(1)
            if features is not None:
                share = self.gather_share(found.delta, found.pdf, width, a_0, far)
            beyond = replace(walk.advance(self, here, found), L=mi.Color3f(0))
            beyond.active &= share > 0
            follows = mi.Bool(beyond.active)
            beyond, n_rays, sampler = self.gather(scene, lights, field, sampler, beyond, width, a_0, path.β)
            return i + 1, Traced(
                traced.direct + found.direct,
                traced.residual + dr.select(found.traced, share * (beyond.L - Li_cache), 0),
                traced.n_rays + dr.select(follows, n_rays + 1, 0),
                traced.covered + dr.select(beyond.valid, 1, 0),
            ), cache + Li_cache, sampler

        none = Traced(mi.Color3f(0), mi.Color3f(0), mi.UInt32(0), mi.Float(0))
        _, traced, cache, sampler = dr.while_loop(
            (mi.UInt32(0), none, mi.Color3f(0), sampler), lambda i, *_: active & (i < n_light), sample,
            label="traced samples",
        )  # fmt: skip
        return traced, cache, sampler

    def cache_samples_only(self, field, features, path, bsdf, sampler):
        """Sum of the cache's predictions in the directions that are not traced: (sum, sampler)."""
        n = max(self.cache_samples - self.n_light, 0)
        if n == 0:
            return mi.Color3f(0), sampler

        def sample(i, cache, sampler):
            lobe, direction = sampler.stratified_1d(EXTRA_LOBE, n, i), sampler.stratified_2d(EXTRA, n, i)
            turn = self.walk.sample(path, bsdf, lobe, direction)
            answer = turn.weight * field.query(features, turn.d)
            return i + 1, cache + dr.select(turn.delta, 0, answer), sampler

        _, cache, sampler = dr.while_loop(
            (mi.UInt32(0), mi.Color3f(0), sampler), lambda i, *_: path.active & (i < n), sample, label="cache samples"
        )
        return cache, sampler

    def gather_share(self, delta, pdf, width, a_0, far):
        """How much of a direction's light is gathered at what it meets, instead of read from the cache here.

        1 for delta and sharp lobes; 1 where the next surface is so near that the cache would blur what the pixel sees
        (spread `width` below its threshold), unless `termination` is ``primary``; elsewhere `far`, or by
        ``balanced_shares`` its own.
        """
        needed = delta | (pdf > SHARP_PDF)
        if self.termination != "primary":
            needed |= ~spread.exceeds(width, a_0, self.spread_threshold)
        share = far
        if self.termination == "balanced_shares":
            share = spread.follow_probability(max(self.cache_samples, 1), pdf)
        return dr.select(needed, 1, share)

    def gather(self, scene, lights, field, sampler, path, width, a_0, β_first):
        """Light that ``path.si`` reflects back along ``path.ray``, times ``path.β``; in ``path.L`` of what is returned.

        Next-event estimation there, the rest from the cache at the first vertex where the path is wide enough, by path
        tracing up to there. `width`: square root of the path's spread. `β_first`: throughput up to where `path` began.
        Returns (path, rays that were traced for more than direct light, sampler).
        """
        cached, walk = self.cached(field), self.walk

        def step(path, width, n_rays, sampler):
            wide = mi.Bool(False)
            if cached:
                wide = walk.terminal(path, path.active) & spread.exceeds(width, a_0, self.spread_threshold)

            def stops(pdf):
                return wide & (pdf <= SHARP_PDF)

            # Next-event estimation shares the work only with rays that are followed. What shines through a mask
            # competes with it at later vertices, too, so that in scenes with masks and media all rays are
            how = {} if walk.may_stay else {"follow": lambda bs, delta: delta | ~stops(bs.pdf), "alone": stops}
            found, sampler = walk.bounce(self, scene, lights, path, sampler, **how)
            after = walk.advance(self, path, found)
            if cached:
                stop = stops(found.pdf) & ~found.delta
                more = material_at(field, walk, path, path.si.bsdf(path.ray), stop)
                Li_cache = field.query(field.encode(*walk.place(path), **more), found.ray.d)
                after.L += dr.select(stop, path.β * found.turn * Li_cache, 0)
                if walk.may_stay:
                    after.active &= ~stop
            width += walk.segment_spread(path, found)
            after, sampler = paths.roulette(after, sampler, self.rr_depth + walk.later, β_first)
            return after, width, n_rays + dr.select(after.active, 1, 0), sampler

        path, _, n_rays, sampler = dr.while_loop(
            (path, mi.Float(width), mi.UInt32(0), sampler), lambda path, *_: path.active, step, label="gather"
        )
        return path, n_rays, sampler

    def to_string(self):
        return (
            f"NIRCIntegrator[\n  termination = {self.termination},\n  cache_samples = {self.cache_samples},\n"
            f"  light_samples = {self.n_light}{' (chosen)' if self.light_samples < 0 else ''},\n"
            f"  max_depth = {self.max_depth},\n"
            f"  training = {self.cache.training},\n  network = {self.cache.shape},\n"
            f"  frames trained = {self.cache.steps},\n  plan = {self.state.plan or self.plan_mode}\n]"
        )


NIRCIntegrator.CHANNELS = {
    "direct": 3, "cache": 3, "residual": 3, "sigma": 1, "preference": 1, "depth": 1
}  # fmt: skip
NIRCIntegrator.__doc__ = (
    r"""
    .. _integrator-nirc:

    Neural incident radiance cache (:monosp:`nirc`)
    -----------------------------------------------

    Estimates all light with little noise and a small bias: at the first vertex that is no mirror, direct light is
    traced as in ``path`` (next-event estimation and BSDF rays, weighted against each other; environment included), and
    light that was reflected before is read from a network trained while rendering, which knows the incident radiance
    :math:`L(x, \omega)` (Dereviannykh et al. 2025, "Neural Two-Level Monte Carlo Real-Time Rendering", eq. for the
    cache-based estimator):

    .. math:: L_o = L_e + L_{direct} + \frac{1}{N_c} \sum_i \frac{L_{cache}(x, \omega_i) f \cos\theta_i}{p(\omega_i)}
              + \frac{1}{N_l} \sum_j u_j \frac{(L_{gather} - L_{cache})(x, \omega_j) f \cos\theta_j}{p(\omega_j)}.

    The last sum runs over the directions that were traced for direct light anyway. It replaces the cache's prediction
    by what is gathered one vertex later (next-event estimation there, the rest from the cache there), with a share
    :math:`u` that is 1 for mirrors, sharp lobes and surfaces so near that the cache would blur what the pixel sees, and
    elsewhere depends on ``termination``. :math:`E[L_o]` is the path-traced radiance if the cache is exact.

    The cache holds light that was reflected at least once, next-event estimation included. It does not hold emission.

    .. pluginparameters::

     * - termination
       - |string|
       - How a camera sample uses the cache. With ``primary``, ``spread`` and ``balanced_shares`` by the sums above: the
         share u of far light is 0 with ``primary`` (least noise, most bias), 1 with ``spread``, and 1 - t with
         ``balanced_shares``, where t = Nc p_f / (Nc p_f + p_g) and :math:`p_f = 1/\pi`. With ``balanced`` a path stops
         at each vertex with the probability t, and queries the cache there for the light from the direction of its BSDF
         sample, without a ray (Dereviannykh et al.). ``adaptive``: by the sums; u is 0 for one sample a pixel and grows
         with the number of samples, because then noise falls and bias remains. With ``adaptive`` and ``denoised`` a
         path stops at the first vertex where its spread a exceeds c a_0 (Müller et al. 2021, sec. 3.4). Where paths
         stop, ``light_samples`` has no effect. (Default: adaptive)
     * - denoised
       - |bool|
       - The image will be denoised, which removes noise but no bias; see ``termination``. ``mi-neural`` sets it with
         ``--denoise``. (Default: false)
     * - cache_samples
       - |int|
       - Directions :math:`N_c` in which the cache is queried per camera sample. 0: no cache, ``nirc`` is a path tracer.
         (Default: 4)
     * - cache
       - |string|
       - What the cache is. ``network``: hash grid and MLP. Two controls without a network: ``spatial_hash``, means of
         the records by cell and direction, and ``sh_grid``, spherical harmonics on a hash grid; of the sizes they take
         ``levels`` and ``hashmap_size`` alone, with defaults of their own. ``plan``: as the plan says, which is the
         network (``mi-neural doc measured`` compares them). (Default: plan)
     * - light_samples
       - |int|
       - Emitter samples, and traced BSDF samples :math:`N_l`, at the first vertex per camera sample. -1: 1, 2 or 4, by
         the noise of direct light, which is measured once per scene. (Default: -1)
     * - spread_threshold
       - |float|
       - Constant c of the spread test a > c a_0; 0: no surface is too near. For paths that stop (see ``termination``)
         it is at least N/256, N being the samples a pixel. (Default: 0.01; for paths that stop 1)
     * - gather_half
       - |float|
       - Samples a pixel, beyond the first, at which ``adaptive`` gathers half of the far light. (Default: 4)"""
    + INCIDENT_KEYS
    + BLEND_KEYS
    + SHARED_KEYS
    + INCIDENT_PRESETS
    + r"""
    Channels: ``direct``, ``cache``, ``residual`` (RGB each); with visible emission they sum to the image. ``sigma``:
    weight of the network being trained, at the first vertex; ``preference``: 1 where it exceeds 1/2. Its mean over a
    frame's records is ``reliability`` in the statistics. ``depth``: mean length of paths in segments, those that find
    direct light alone not counted.

    In participating media the first vertex may be a point where a medium scatters. All values of ``termination`` work
    there: the phase function stands in the place of :math:`f \cos\theta`. :math:`L_{cache}(x, \omega)` is the light
    that arrives at x through the medium: what it absorbs and scatters on the way is taken into account. The light that
    comes from emitters in a straight line is not in it. Training paths run on to their natural end there. Where
    surfaces let a part of the light pass (masks), a path that stops traces a ray for direct light. In frames ``nrc``
    and ``neural_path`` have less error in media: ``mi-neural doc media``.

    *Works with* all surfaces, emitters and media of Mitsuba, RGB variants ``llvm_ad_rgb`` and ``cuda_ad_rgb``. *Leaves
    out* phase functions of microflakes (``sggx``: use ``volpath``), gradients in media (use ``prbvolpath``),
    polarization, spectral rendering, and a limit to the number of bounces inside the cache (use ``path``). Light of
    very bright places shows through thin walls until some 300 frames were trained (use ``termination="spread"``).

    Errors: ``ValueError`` for a key out of range, a scene without emitters or sensors;
    :class:`~mi_neural.caches.field.CacheFileError` for cache files.

    .. tabs::
        .. code-tab:: xml

            <integrator type="nirc">
                <integer name="cache_samples" value="8"/>
                <string name="termination" value="adaptive"/>
            </integrator>

        .. code-tab:: python

            integrator = mi.load_dict({"type": "nirc", "cache_samples": 8})
            integrator.train(scene, 300)               # optional: the first image trains by itself
            image = mi.render(scene, integrator=integrator, spp=16)
    """
)
register("nirc", lambda props: older_name(props) or NIRCIntegrator(props))
