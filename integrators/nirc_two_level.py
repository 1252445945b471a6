"""``nirc_two_level``: the incident radiance cache as a control variate, unbiased for any cache."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.caches.control import ControlCache
from mi_neural.integrators import pilot, progressive
from mi_neural.integrators.common import SHARED_KEYS, CacheIntegrator
from mi_neural.integrators.first_vertex import first_vertex
from mi_neural.integrators.pilot import Split
from mi_neural.integrators.progressive import UNBIASED, Parts
from mi_neural.transport import two_level, vertex

MODES = ("unbiased", "progressive")
#: A lobe that sends a sample with a density above this (per steradian) is always traced, and never by the cache.
SHARP_PDF = 3.0
#: Share of the scene's mean radiance that RIS grants every direction, so that light unknown to the cache is found.
DEFENSIVE = 0.25
#: Queries per vertex with `every_vertex`: the direction that is followed, and another.
INNER = 2
#: Dimensions of the stratified numbers
AA, NEE, BSDF, LOBE, EXTRA, EXTRA_LOBE, LIGHT, KEPT = range(8)
#: Dimensions of the numbers that decide together, from here on one for each depth of each traced path
TOGETHER = 16


class NIRCTwoLevelIntegrator(CacheIntegrator):
    def __init__(self, props):
        self.choice, self.mixed, self.compiling = None, None, False
        super().__init__(props)
        self.mode = props.get("mode", "unbiased")
        self.every_vertex = props.get("every_vertex", False)
        self.ris = props.get("ris", False)
        given = {
            "cache_samples": props.get("cache_samples", None), "residual_samples": props.get("residual_samples", None),
            "residual_probability": props.get("residual_probability", None), "alpha": props.get("alpha", None),
        }  # fmt: skip
        self._check(self.mode in MODES, f"mode is '{self.mode}'; give one of: {', '.join(MODES)}")
        self._check(self.cache.blend == "ema", f"blend is '{self.cache.blend}'; the two-level estimator needs 'ema'")
        if self.ris:
            self._check(given["residual_samples"] in (None, 1),
                        "ris chooses one direction; leave residual_samples at 1")  # fmt: skip
            given["residual_samples"] = 1
        if self.mode == "progressive" and given["alpha"] is None and given["cache_samples"] is None:
            given["alpha"] = 0.0  # the cache is in the biased part already
        try:
            self.choice = pilot.Choice(**given)
        except ValueError as e:
            raise ValueError(f"{self.plugin}: {e}") from None
        if self.choice.may_ask:
            self.cache = ControlCache(self.cache.training, self.cache.shape, self.seed)
        self.inner_channels = [*UNBIASED, *(c for c in self.channels if c not in UNBIASED)]
        self.mixed = progressive.Mixed(self, props) if self.mode == "progressive" else None

    @property
    def CHOOSES_LIGHTS(self) -> bool:
        """Lights are chosen as the plan says, but where it is path tracing by its keys."""
        return self.choice.may_ask or self.mixed is not None

    @property
    def needs_cache(self) -> bool:
        return super().needs_cache and (self.choice.may_ask or self.mixed is not None)

    @property
    def split(self) -> Split:
        """How a camera sample is divided now."""
        return self.choice.split

    @property
    def queries_per_sample(self) -> float:
        return float(self.split.n_cache) if self.needs_cache and self.split.alpha != 0 else 0.0

    def settings(self, spp: int) -> tuple:
        return self.split.numbers()

    def reset(self) -> None:
        super().reset()
        for part in (self.choice, self.mixed):
            if part is not None:
                part.reset()

    def share_cache(self, other) -> None:
        """Go on with the cache of another integrator, ``nirc`` or this one; either trains it for both from now on.

        Raises ValueError where sizes differ or `other` has none.
        """
        field = getattr(getattr(other, "cache", None), "field", None)
        self._check(field is not None, "share_cache() needs an integrator with a trained cache; call its train() first")
        self._check(field.shape == self.cache.shape, f"its cache is of {field.shape}, this one of {self.cache.shape}; "
                    "give both the same sizes")  # fmt: skip
        self.cache.adopt(field)
        self.choice.reset()

    def load_cache(self, path, scene=None) -> None:
        super().load_cache(path, scene)
        self.choice.reset()

    def _meet(self, scene, is_another: bool) -> None:
        super()._meet(scene, is_another)
        if is_another and self.mixed is not None:
            self.mixed.nirc.state.passes.clear()
            self.mixed.compiled.clear()

    def _ready(self, scene, sensor, train: bool = True) -> None:
        super()._ready(scene, sensor, train)
        if not self.choice.may_ask or self.state.image_open or not (train or self.compiling):
            return
        with dr.suspend_grad():
            self.choice.know_alpha(self, scene, sensor, self.split.alpha < 0)
            if self.mixed is None and (self.choice.rendered >= pilot.WORTH or self.compiling):
                self.choice.measure(self, scene, sensor)

    def measure(self, scene, sensor=0) -> dict:
        """Choose the division of a camera sample now, where it is not given. Returns :meth:`statistics`."""
        sensor = self._sensor(scene, sensor)
        self._ready(scene, sensor, train=False)
        if self.needs_cache and self.choice.may_ask:
            with dr.suspend_grad():
                self.choice.measure(self, scene, sensor)
        return self.statistics()

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """One image: train as the keys say, then render `spp` samples a pixel (0: the sampler's own count)."""
        sensor = self._sensor(scene, sensor)
        size, expected = sensor.film().crop_size(), self.state.planned_spp or spp or sensor.sampler().sample_count()
        before, pixels = self.choice.rendered, int(size[0]) * int(size[1])
        self.choice.rendered += expected * pixels
        result = super().render(scene, sensor, seed, spp, develop, evaluate)
        self.choice.rendered = before + (spp or sensor.sampler().sample_count()) * pixels
        return result

    def prepare(self, scene, sensor=0, spp: int = 1) -> None:
        """Compile all that a render call with `spp` needs. What was learned and measured so far stays as it is."""
        known, self.compiling = self.choice.state(), True
        try:
            super().prepare(scene, sensor, spp)
        finally:
            self.compiling = False
        self.choice.restore(known)
        if self.mixed is not None:
            self.mixed.begin()

    def train_fraction(self, seconds: float) -> float:
        # The unbiased estimate gains little from a better cache, if it asks it at all
        return super().train_fraction(seconds) * (1.0 if self.mixed is not None else 0.3)

    def statistics(self) -> dict:
        return super().statistics() | self.choice.statistics()

    def plan_samples(self, spp: int | None) -> None:
        super().plan_samples(spp)
        if self.mixed is not None:
            self.mixed.plan_samples(spp)

    def _render(self, scene, sensor, seed: int, spp: int):
        if self.mixed is not None:
            take = self.mixed.compile if self.compiling else self.mixed.add
            take(scene, sensor, seed, spp, lambda seed, n: self._parts(scene, sensor, seed, n))
            if self.compiling:
                return sensor.film().create_block()
            parts, n = self.mixed.parts(), self.mixed.n_unbiased
        elif any(name.startswith("variance") for name in self.channels):
            parts, n = Parts.of(self._parts(scene, sensor, seed, spp), self.inner_channels, self), spp
        else:
            return super()._render(scene, sensor, seed, spp)
        film = sensor.film()
        film.prepare(self.aov_names())
        values = mi.TensorXf(parts.shown(self.channels, n).astype(np.float32))
        return mi.ImageBlock(values, film.crop_offset(), film.rfilter())

    def _parts(self, scene, sensor, seed: int, spp: int):
        """A block of unbiased samples with all that variances and `progressive` are made of."""
        shown, self.channels = self.channels, self.inner_channels
        try:
            return super()._render(scene, sensor, seed, spp)
        finally:
            self.channels = shown

    @property
    def cumulative(self) -> bool:
        """Whether the image of one call already stands for all calls since `plan_samples`."""
        return self.mixed is not None

    # -------------------------------------------------------------------------------------------------------------

    def estimate(self, scene, lights, field, sampler, ray, settings, active):
        """E[L] is path tracing's, whatever the cache: direct light + :func:`two_level.combine` at the first vertex."""
        n_traced, n_cache, probability, alpha = settings
        L, β, ray, si, depth, visible, active, sampler = first_vertex(self, scene, sampler, ray, active)
        bsdf = si.bsdf(ray)

        # ----------- How far the cache is believed here; where its terms would cancel, it is not asked
        α, features = mi.Float(0), None
        if self.choice.may_ask and field is not None:
            cancels = (n_cache <= n_traced) & (probability >= 1)
            asked = active & vertex.has_smooth(bsdf) & ~cancels
            α = self.coefficient(field, si, alpha, asked)
            asked &= (α > 0) | (mi.Bool(self.ris) & (n_cache > 1))
            features = field.encode(si.p, vertex.facing(si), asked)
        else:
            asked = mi.Bool(False)

        def candidate(dimension, dimension_lobe, n, i):
            """A BSDF sample, its weight, and what the cache says of it."""
            bs, weight = bsdf.sample(
                mi.BSDFContext(), si, sampler.stratified_1d(dimension_lobe, n, i),
                sampler.stratified_2d(dimension, n, i), active,
            )  # fmt: skip
            weight = vertex.finite(weight, active)
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            cached = mi.Color3f(0)
            if features is not None:
                asks = asked & ~delta & (bs.pdf <= SHARP_PDF)
                cached = dr.select(asks, weight * field.query(features, si.to_world(bs.wo), asks), 0)
            return bs, weight, delta, vertex.finite(cached, active)

        def traced_sample(i, direct, cache, residual, sampler, kept=None):
            if kept is None:
                bs, weight, delta, cached = candidate(BSDF, LOBE, mi.UInt32(n_traced), i)
                cache += cached
            else:
                bs, weight, delta, cached = kept
            next_ray = si.spawn_ray(si.to_world(bs.wo))
            alive = active & (dr.max(weight) > 0)

            # ---- Direct light: by next-event estimation, and what is there
            si_next = scene.ray_intersect(next_ray, alive)
            L_nee, Le = vertex.emitted(
                scene, lights, si, bsdf, sampler.stratified_1d(LIGHT, mi.UInt32(n_traced), i),
                sampler.stratified_2d(NEE, mi.UInt32(n_traced), i), sampler, active, si_next, bs.pdf, delta, alive,
            )  # fmt: skip
            direct += L_nee + weight * Le

            # ------------ Indirect light: traced or not ---------------
            q = dr.select(delta | (bs.pdf > SHARP_PDF), 1, probability)
            keep = active & (sampler.together_1d(KEPT) < q)
            follow = keep & alive & si_next.is_valid() & (depth + 1 < self._max_depth)
            traced, sampler = self.suffix(
                scene, lights, field, sampler, next_ray, si_next, depth + 1, weight, β, bs.eta, alpha,
                mi.UInt32(i) * 64 + TOGETHER, follow,
            )  # fmt: skip
            residual += two_level.residual(traced, cached, α, q, keep)
            return i + 1, direct, cache, residual, sampler

        zero = mi.Color3f(0)
        direct, cache, residual = mi.Color3f(zero), mi.Color3f(zero), mi.Color3f(zero)
        if self.ris:
            # One candidate is kept as it is: path tracing
            n_candidates = mi.UInt32(dr.maximum(n_cache, 1))
            cache, kept, sampler = self.resampled(candidate, field, n_candidates, sampler, active)
            _, direct, _, residual, sampler = traced_sample(mi.UInt32(0), direct, zero, residual, sampler, kept)
        else:
            _, direct, cache, residual, sampler = dr.while_loop(
                (mi.UInt32(0), direct, cache, residual, sampler),
                lambda i, *_: active & (mi.Float(i) < n_traced), traced_sample, label="traced samples",
            )  # fmt: skip
            # ----------------- Cache samples without a ray ----------------
            n_extra = mi.UInt32(dr.maximum(n_cache - n_traced, 0))

            def cache_sample(i, cache):
                return i + 1, cache + candidate(EXTRA, EXTRA_LOBE, n_extra, i)[3]

            _, cache = dr.while_loop(
                (mi.UInt32(0), cache), lambda i, cache: asked & (i < n_extra), cache_sample, label="cache samples"
            )
        n_asked = n_cache if self.ris else dr.maximum(n_cache, n_traced)
        indirect = two_level.combine(cache, n_asked, residual, n_traced, α)
        direct = direct / n_traced
        L += dr.select(active, β * (direct + indirect), 0)

        cache_part = indirect - residual / n_traced
        channels = {
            "direct": β * direct, "cache": β * cache_part, "residual": β * residual / n_traced, "alpha": α,
            # Squares; variances once all samples of a pixel are there
            "variance_cache": dr.square(β * cache_part), "variance_residual": dr.square(β * residual / n_traced),
            "variance_indirect": dr.square(β * indirect),
        }  # fmt: skip
        return L, visible, {k: dr.select(active, v, 0) for k, v in channels.items()}

    @property
    def _max_depth(self) -> int:
        return self.max_depth if self.max_depth >= 0 else 0x7FFFFFFF

    def coefficient(self, field, si, alpha, active):
        """α at a vertex: `alpha` itself, or by place where it is negative; 0 where not `active`."""
        by_place = active & (alpha < 0)
        return dr.select(active, dr.select(by_place, field.alpha_at(si.p, vertex.facing(si), by_place), alpha), 0)

    def resampled(self, candidate, field, n, sampler, active):
        """One of `n` directions, kept in proportion to what the cache says comes from there: (sum of what it says,
        (BSDF sample, weight, delta, cached) with the RIS weight in both, sampler)."""
        defensive = DEFENSIVE * (field.scale if field is not None else mi.Float(1))

        def consider(i, cache, t_sum, t_kept, bs, weight, delta, cached, sampler):
            new = candidate(EXTRA, EXTRA_LOBE, n, i)
            t = two_level.resampling_target(new[3], new[1], defensive)
            t_sum += t
            take = sampler.next_1d() * t_sum < t
            bs, weight, delta, cached = (
                dr.select(take, a, b) for a, b in zip(new, (bs, weight, delta, cached), strict=True)
            )
            return i + 1, cache + new[3], t_sum, dr.select(take, t, t_kept), bs, weight, delta, cached, sampler

        zero = mi.Float(0)
        state = (mi.UInt32(0), mi.Color3f(0), zero, mi.Float(zero), dr.zeros(mi.BSDFSample3f), mi.Color3f(0),
                 mi.Bool(False), mi.Color3f(0), sampler)  # fmt: skip
        _, cache, t_sum, t, bs, weight, delta, cached, sampler = dr.while_loop(
            state, lambda i, *_: active & (i < n), consider, label="candidates"
        )
        w = two_level.resampling_weight(t_sum, mi.Float(n), t)
        return cache, (bs, w * weight, delta, w * cached), sampler

    def suffix(self, scene, lights, field, sampler, ray, si, depth, weight, β_first, η, alpha, dimension, active):
        """``weight`` times the light that `si`, `depth` segments from the camera, reflects back along `ray`.

        Path tracing; with `every_vertex` the cache is a control variate at each vertex. Roulette is by the throughput
        from the camera, `β_first` `weight` at `si`.
        """
        ctx = mi.BSDFContext()

        def bounce(depth, ray, si, β, η, L, active, sampler):
            bsdf = si.bsdf(ray)
            bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active)
            weight = vertex.finite(weight, active)
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            wo = si.to_world(bs.wo)
            next_ray = si.spawn_ray(wo)
            alive = active & (dr.max(weight) > 0)
            si_next = scene.ray_intersect(next_ray, alive)
            L_nee, Le = vertex.emitted(
                scene, lights, si, bsdf, sampler.next_1d(), sampler.next_2d(), sampler, active, si_next, bs.pdf, delta,
                alive,
            )  # fmt: skip
            L += β * (L_nee + weight * Le)

            # Roulette (must cancel out η² to obtain unitless throughput)
            β_next, η = β * weight, η * bs.eta
            depth = depth + 1
            q = dr.minimum(dr.max(β_first * β_next) * η**2, 0.95)
            q = dr.select(depth > self.rr_depth, q, 1)
            kept = active & (sampler.together_1d(dimension + depth) < q)
            inv_q = dr.rcp(dr.maximum(q, 1e-6))

            if self.every_vertex and self.choice.may_ask and field is not None:
                asked = active & vertex.has_smooth(bsdf)
                α = self.coefficient(field, si, alpha, asked)
                asked &= α > 0
                features = field.encode(si.p, vertex.facing(si), asked)
                said = asked & ~delta & (bs.pdf <= SHARP_PDF)
                followed = vertex.finite(weight * field.query(features, wo, said), said)
                bs_2, weight_2 = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), asked)
                rough = asked & ~mi.has_flag(bs_2.sampled_type, mi.BSDFFlags.Delta) & (bs_2.pdf <= SHARP_PDF)
                other = vertex.finite(weight_2 * field.query(features, si.to_world(bs_2.wo), rough), rough)
                zero = mi.Color3f(0)
                cancels = two_level.residual(zero, followed, α, 1 / inv_q, kept)
                L += β * two_level.combine(followed + other, mi.Float(INNER), cancels, 1, α)

            β = β_next * inv_q
            active = kept & alive & si_next.is_valid() & (depth < self._max_depth) & (dr.max(β) > 0)
            return depth, next_ray, si_next, β, η, L, active, sampler

        state = (mi.UInt32(depth), mi.Ray3f(ray), si, mi.Color3f(weight), mi.Float(η), mi.Color3f(0), mi.Bool(active),
                 sampler)  # fmt: skip
        *_, L, _, sampler = dr.while_loop(state, lambda *s: s[6], bounce, label="residual path")
        return L, sampler

    def to_string(self):
        return (
            f"NIRCTwoLevelIntegrator[\n  mode = {self.mode},\n  split = {self.split},\n"
            f"  every_vertex = {self.every_vertex},\n  ris = {self.ris},\n  max_depth = {self.max_depth},\n"
            f"  training = {self.cache.training},\n  network = {self.cache.shape},\n"
            f"  frames trained = {self.cache.steps}\n]"
        )


NIRCTwoLevelIntegrator.CHANNELS = {
    "direct": 3, "cache": 3, "residual": 3, "alpha": 1, "variance_cache": 3, "variance_residual": 3,
    "variance_indirect": 3,
}  # fmt: skip
NIRCTwoLevelIntegrator.__doc__ = (
    r"""
    .. _integrator-nirc_two_level:

    Two-level estimator with a neural incident radiance cache (:monosp:`nirc_two_level`)
    ------------------------------------------------------------------------------------

    Estimates all light without bias, whatever the cache says: at the first surface that is not a mirror, direct light
    is traced as in ``path``, indirect light is the cache's answer and the traced difference to it (Dereviannykh et al.
    2025, "Neural Two-Level Monte Carlo Real-Time Rendering", the two-level estimator):

    .. math:: L_o = L_e + L_{direct}
              + \frac{1}{N_c} \sum_i \frac{\alpha L_{cache}(x, \omega_i) f \cos\theta_i}{p(\omega_i)}
              + \frac{1}{N_r} \sum_j \frac{(L - \alpha L_{cache})(x, \omega_j) f \cos\theta_j}{p(\omega_j)}.

    :math:`E[L_o]` does not depend on the cache: trained, untrained or nonsense, it changes the variance alone. Emission
    met by a BSDF ray carries its MIS weight and is no part of the sums; mirrors and sharp lobes are always traced.

    On a CPU a query costs a tenth to a third of a path, and most of the variance lies in the paths' far ends, of which
    the cache knows nothing. So this integrator *measures*: what is not given of the four keys that divide a camera
    sample is chosen by a pilot, which renders some rows with each division and takes the one of least variance times
    time; path tracing is among them, at its own cost, and what small images get. ``statistics()["pilot"]`` shows the
    numbers; ``measure(scene)`` has them taken at once. Random numbers of the first vertex are stratified over a pixel's
    samples (Owen-scrambled Sobol), and packets of neighbouring pixels decide together where paths end.

    .. pluginparameters::

     * - mode
       - |string|
       - ``unbiased``, or ``progressive``: most samples are those of ``nirc``, which share the cache, and the more of
         them unbiased ones the more bias is found; the image is the biased one plus that part of the unbiased one's
         difference, scale by scale, that stands out of its noise; biased, and consistent: it tends to the unbiased
         image. For "the best image in T seconds". The unbiased part is path tracing there, unless the keys below say
         otherwise. (Default: unbiased)
     * - cache_samples
       - |int|
       - Directions :math:`N_c` in which the cache is asked per camera sample, those that are traced included. 0: path
         tracing. (Default: measured)
     * - residual_samples
       - |int|
       - Directions that are traced for direct light, and of which :math:`N_r` go on. (Default: measured, 1, 2 or 4; 1
         where the cache is never asked)
     * - residual_probability
       - |float|
       - Probability, in (0, 1], with which a traced direction goes on beyond direct light: :math:`N_r` is this times
         ``residual_samples``. (Default: measured, 1, 1/2 or 1/4)
     * - alpha
       - |string| or |float|
       - Coefficient of the control variate: a number in [0, 1], 1 being the paper's choice and 0 path tracing; or
         ``cell``: by place, Cov(y, f)/Var(f) over the training records of earlier frames, cut to [0, 1]. (Default:
         measured, 0 or ``cell``)
     * - every_vertex
       - |bool|
       - Use the cache as a control variate at each vertex of the residual path, too, with two queries a vertex.
         (Default: false)
     * - ris
       - |bool|
       - Choose the one traced direction among the ``cache_samples`` that were asked, in proportion to f cos L plus a
         defensive share (resampled importance sampling); MIS goes on with the density of the candidates. Was worth
         its time in one of seven scenes measured (README). (Default: false)
    """
    + SHARED_KEYS.strip("\n")
    + r"""

    Channels: ``direct``, ``cache`` (its part of the sum, with α), ``residual`` (RGB each; with visible emission they
    sum to the image of mode ``unbiased``), ``alpha``; ``variance_cache``, ``variance_residual``,
    ``variance_indirect`` (RGB each): sample variances of one camera sample; over the number of samples they are
    the variance of the pixel.

    *Works with* all surfaces and emitters of Mitsuba, RGB variants ``llvm_ad_rgb`` and ``cuda_ad_rgb``. *Leaves out*
    participating media (use ``volpath``), polarization, spectral rendering, ``blend`` (use ``nirc``).
    ``share_cache(other)`` goes on with the cache of a ``nirc``; cache files of either can be read by both.

    Errors: ``ValueError`` for a key out of range, a scene without emitters, sensors or with media;
    :class:`~mi_neural.caches.field.CacheFileError` for cache files.

    .. tabs::
        .. code-tab:: xml

            <integrator type="nirc_two_level">
                <string name="mode" value="progressive"/>
                <emitter type="nvc_lights" name="light_sampler"/>
            </integrator>

        .. code-tab:: python

            integrator = mi.load_dict({"type": "nirc_two_level", "cache_samples": 4, "alpha": 1.0})
            image = mi.render(scene, integrator=integrator, spp=64)
            print(integrator.statistics()["split"])
    """
)
mi.register_integrator("nirc_two_level", lambda props: NIRCTwoLevelIntegrator(props))
