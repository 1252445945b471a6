"""``nirc_two_level``: the incident radiance cache as a control variate, unbiased for any cache."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.caches.control import ControlCache
from mi_neural.caches.material import material_of
from mi_neural.caches.outlook import Outlook
from mi_neural.estimators import two_level
from mi_neural.estimators.spread import SHARP_PDF
from mi_neural.integrators import pilot, progressive
from mi_neural.integrators.first_vertex import FirstVertex, Sums
from mi_neural.integrators.incident import INCIDENT_KEYS, INCIDENT_PRESETS, IncidentIntegrator
from mi_neural.integrators.keys import SHARED_KEYS, register
from mi_neural.integrators.pilot import Split
from mi_neural.integrators.progressive import UNBIASED, Parts
from mi_neural.render import path as paths
from mi_neural.render import vertex
from mi_neural.render.ends import Ends
from mi_neural.render.film import Area
from mi_neural.render.frozen import locked

MODES = ("unbiased", "progressive")
#: Queries per vertex with `every_vertex`: the direction that is followed, and another.
INNER = 2


class NIRCTwoLevelIntegrator(IncidentIntegrator):
    GRADIENT = "traced"

    def __init__(self, props):
        self.choice, self.mixed, self.compiling = None, None, False
        super().__init__(props)
        self.mode = props.get("mode", "unbiased")
        self.every_vertex = props.get("every_vertex", False)
        self.ris = props.get("ris", False)
        given = {
            "cache_samples": props.get("cache_samples", None), "residual_samples": props.get("residual_samples", None),
            "residual_probability": props.get("residual_probability", None), "alpha": props.get("alpha", None),
            "roulette": props.get("roulette", None), "guide": props.get("guide", None),
        }  # fmt: skip
        self._check(self.mode in MODES, f"mode is '{self.mode}'; give one of: {', '.join(MODES)}")
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
    def bound_field(self):
        """The cache, with an outlook where the division in use needs one: path tracing has a kernel of its own."""
        field, split = super().bound_field, self.split
        if split.roulette == 0 and split.guide == 0:
            return field
        return Foreseen(field, (self.choice.outlook or Outlook.blank()).view(split.guide > 0))

    @property
    def trains(self) -> bool:
        return super().trains or self.choice.must_look_ahead

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
        self.state.begun = False
        self.choice.reset()

    def load_cache(self, path, scene=None) -> None:
        super().load_cache(path, scene)
        self.choice.reset()

    def _begin(self, scene, is_another: bool) -> None:
        super()._begin(scene, is_another)
        if is_another:
            self.choice.outlook = None
        if is_another and self.mixed is not None:
            self.mixed.forget_scene()

    def bind(self, scene, sensor, train: bool = True) -> None:
        super().bind(scene, sensor, train)
        if self.choice.must_look_ahead:
            self.choice.look_ahead(self, scene, sensor)
        if not self.choice.may_ask or self.state.image_open or not (train or self.compiling):
            return
        if self.cache.queried is None:  # no surface is seen that could be learned
            return
        with dr.suspend_grad():
            self.choice.know_alpha(self, scene, sensor, self.split.alpha < 0)
            if self.mixed is None and (self.choice.rendered + self.choice.under_way >= pilot.WORTH or self.compiling):
                self.choice.measure(self, scene, sensor)

    @locked
    def measure(self, scene, sensor=0) -> dict:
        """Choose the division of a camera sample now, where it is not given. Returns :meth:`statistics`."""
        sensor = self._sensor(scene, sensor)
        self.bind(scene, sensor, train=False)
        if self.needs_cache and self.choice.may_ask and self.cache.queried is not None:
            with dr.suspend_grad():
                self.choice.measure(self, scene, sensor)
        return self.statistics()

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """One image: train as the keys say, then render `spp` samples a pixel (0: the sampler's own count)."""
        sensor = self._checked(scene, sensor, spp)
        spp = spp or sensor.sampler().sample_count()
        pixels = Area.of(sensor).n_pixels
        self.choice.under_way = (self.planned_spp or spp) * pixels
        try:
            image = super().render(scene, sensor, seed, spp, develop, evaluate)
        finally:
            self.choice.under_way = 0
        self.choice.rendered += spp * pixels
        return image

    @locked
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

    def _render(self, scene, sensor, seed, spp: int):
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

    def _parts(self, scene, sensor, seed, spp: int):
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
        n_traced, n_cache, probability, alpha, strength, guide = settings
        field, outlook = field.parts() if isinstance(field, Foreseen) else (field, None)
        path = paths.camera_vertex(self, scene, ray, active)
        path, sampler = paths.follow_mirrors(scene, path, sampler, self.depth_limit, self.rr_depth)
        helps = (n_cache > n_traced) | (probability < 1)  # elsewhere the cache's terms cancel
        ends = Ends(outlook, strength, guide, path, self.rr_depth)
        first = FirstVertex(self, field, path, alpha, helps, n_cache, ends)
        beyond = partial(self.suffix, scene, lights, field, alpha=alpha, ends=ends)

        none = Sums(*(mi.Color3f(0) for _ in range(3)), mi.Float(0))
        if self.ris:
            # One candidate is kept as it is: path tracing
            n_candidates = mi.UInt32(dr.maximum(n_cache, 1))
            cache, kept, sampler = first.resampled(n_candidates, sampler)
            sums, sampler = first.traced_sample(
                scene, lights, mi.UInt32(0), mi.UInt32(n_traced), probability, none, sampler, beyond, ends, kept
            )
            sums.cache = cache
        else:
            def sample(i, sums, sampler):
                sums, sampler = first.traced_sample(
                    scene, lights, i, mi.UInt32(n_traced), probability, sums, sampler, beyond, ends
                )
                return i + 1, sums, sampler

            _, sums, sampler = dr.while_loop(
                (mi.UInt32(0), none, sampler), lambda i, *_: path.active & (mi.Float(i) < n_traced), sample,
                label="traced samples",
            )  # fmt: skip
            sums.cache += first.cache_samples_only(mi.UInt32(dr.maximum(n_cache - n_traced, 0)), sampler)
        n_queries = n_cache if self.ris else dr.maximum(n_cache, n_traced)
        indirect = two_level.combine(sums.cache, n_queries, sums.residual, n_traced, first.α)
        direct, residual = sums.direct / n_traced, sums.residual / n_traced
        L = path.L + dr.select(path.active, path.β * (direct + indirect), 0)
        coverage = dr.select(path.active, sums.covered / n_traced, dr.select(path.valid, 1.0, 0.0))
        return L, coverage, self._channels(path, direct, indirect, residual, first.α)

    def _channels(self, path, direct, indirect, residual, α) -> dict:
        """What the channels show; squares in the place of variances until all samples of a pixel are there."""
        cache = indirect - residual
        values = {
            "direct": path.β * direct, "cache": path.β * cache, "residual": path.β * residual, "alpha": α,
            "variance_cache": dr.square(path.β * cache), "variance_residual": dr.square(path.β * residual),
            "variance_indirect": dr.square(path.β * indirect),
        }  # fmt: skip
        return {k: dr.select(path.active, v, 0) for k, v in values.items()}

    def coefficient(self, field, si, alpha, active):
        """α at a vertex: `alpha` itself, or by place where it is negative; 0 where not `active`."""
        by_place = active & (alpha < 0)
        return dr.select(active, dr.select(by_place, field.alpha_at(si.p, vertex.facing(si), by_place), alpha), 0)

    def suffix(self, scene, lights, field, path, sampler, dimension, *, alpha, ends):
        """Light that ``path.si`` reflects back along ``path.ray``, times ``path.β``; in ``path.L`` of the result.

        Path tracing; with `every_vertex` the cache is a control variate at each vertex. `ends` says with which
        probability paths go on (:class:`~mi_neural.render.ends.Ends`). Returns (path, sampler).
        """
        controls = self.every_vertex and self.choice.may_ask and field is not None

        def step(path, sampler):
            found, sampler = paths.bounce(scene, lights, path, sampler, bsdf=ends.bsdf(path), direct=ends.direct)
            after = paths.advance(path, found, self.depth_limit)
            u = sampler.together_1d(dimension + after.depth)
            q = ends.survival(after)
            if controls:
                L, sampler = self.control(field, path, found, alpha, u < q, q, sampler)
                after.L += path.β * L
            return paths.roulette(after, sampler, self.rr_depth, u=u, q=q)

        return dr.while_loop(
            (path, sampler), lambda path, sampler: path.active, step, label="residual path"
        )

    def control(self, field, path, found, alpha, kept, q, sampler):
        """The cache as a control variate at a vertex whose path goes on, where `kept`, with probability q: E = 0.

        `INNER` queries: in the direction of the path, and in another. Returns (radiance, sampler).
        """
        si = path.si
        bsdf = si.bsdf(path.ray)
        queries = vertex.is_smooth(si, path.active)
        α = self.coefficient(field, si, alpha, queries)
        queries &= α > 0
        features = field.encode(si.p, vertex.facing(si), queries, **material_of(field, si, bsdf, queries))

        def answer(bs, weight, delta):
            smooth = queries & ~delta & (bs.pdf <= SHARP_PDF)
            return vertex.finite(weight * field.query(features, si.to_world(bs.wo), smooth), smooth)

        followed = answer(found.bs, found.weight, found.delta)
        other = answer(*paths.sample_bsdf(si, bsdf, sampler.next_1d(), sampler.next_2d(), queries))
        cancels = two_level.residual(mi.Color3f(0), followed, α, q, kept)
        return two_level.combine(followed + other, mi.Float(INNER), cancels, 1, α), sampler

    def incident_radiance(self, scene, lights, field, path, found, after, sampler):
        field = field.field if isinstance(field, Foreseen) else field
        return super().incident_radiance(scene, lights, field, path, found, after, sampler)

    def to_string(self):
        return (
            f"NIRCTwoLevelIntegrator[\n  mode = {self.mode},\n  split = {self.split},\n"
            f"  every_vertex = {self.every_vertex},\n  ris = {self.ris},\n  max_depth = {self.max_depth},\n"
            f"  training = {self.cache.training},\n  network = {self.cache.shape},\n"
            f"  frames trained = {self.cache.steps}\n]"
        )


class Foreseen:
    """The cache, and what lies ahead of paths: what a frozen pass is given. A PyTree."""

    DRJIT_STRUCT = {"field": object, "outlook": object}  # noqa: RUF012

    def __init__(self, field=None, outlook=None):
        self.field, self.outlook = field, outlook

    def parts(self) -> tuple:
        return self.field, self.outlook


NIRCTwoLevelIntegrator.CHANNELS = {
    "direct": 3, "cache": 3, "residual": 3, "alpha": 1, "variance_cache": 3, "variance_residual": 3,
    "variance_indirect": 3,
}  # fmt: skip
NIRCTwoLevelIntegrator.__doc__ = (
    r"""
    .. _integrator-nirc_two_level:

    Two-level estimator with a neural incident radiance cache (:monosp:`nirc_two_level`)
    ------------------------------------------------------------------------------------

    Estimates all light without bias, whatever the cache predicts: at the first surface that is not a mirror, direct
    light is traced as in ``path``; indirect light is the cache's prediction plus the traced difference from it
    (Dereviannykh et al. 2025, "Neural Two-Level Monte Carlo Real-Time Rendering", the two-level estimator):

    .. math:: L_o = L_e + L_{direct}
              + \frac{1}{N_c} \sum_i \frac{\alpha L_{cache}(x, \omega_i) f \cos\theta_i}{p(\omega_i)}
              + \frac{1}{N_r} \sum_j \frac{(L - \alpha L_{cache})(x, \omega_j) f \cos\theta_j}{p(\omega_j)}.

    :math:`E[L_o]` does not depend on the cache; the cache changes the variance only. Emission that a BSDF ray hits has
    its MIS weight and is no part of the sums. Mirrors and sharp lobes are always traced.

    On a CPU a query costs a tenth to a third of a path, and most of the variance lies in the paths' far ends, of which
    the cache predicts nothing. So this integrator *measures*. Four keys divide a camera sample; those that are not set
    are chosen by a pilot, which renders some rows with each division and takes the one of least variance times time.
    Path tracing is one of the divisions; small images always use it. ``statistics()["pilot"]`` shows the numbers;
    ``measure(scene)`` measures them at once. Random numbers of the first vertex are stratified over a
    pixel's samples (Owen-scrambled Sobol), and packets of neighbouring pixels decide together where paths end.

    .. pluginparameters::

     * - mode
       - |string|
       - ``unbiased``, or ``progressive``, for the best image in a given time: most samples are those of ``nirc`` with
         the same cache, the others are unbiased. The more bias is measured, the more samples are unbiased. The
         difference of both images is added to the biased one, scale by scale, as far as it exceeds its noise. The
         result is biased, and tends to the unbiased image. The unbiased samples are path tracing, unless the keys below
         say otherwise. (Default: unbiased)
     * - cache_samples
       - |int|
       - Directions :math:`N_c` in which the cache is queried per camera sample, those that are traced included. 0: path
         tracing. (Default: measured)
     * - residual_samples
       - |int|
       - Directions that are traced for direct light, and of which :math:`N_r` go on. (Default: measured, 1, 2 or 4; 1
         where the cache is never queried)
     * - residual_probability
       - |float|
       - Probability, in (0, 1], with which a traced direction goes on beyond direct light: :math:`N_r` is this times
         ``residual_samples``. (Default: measured, 1, 1/2 or 1/4)
     * - alpha
       - |string| or |float|
       - Coefficient of the control variate: a number in [0, 1], 1 being the paper's choice and 0 path tracing; or
         ``cell``: by place, Cov(y, f)/Var(f) over the training records of earlier frames, cut to [0, 1]. (Default:
         measured, 0 or ``cell``)
     * - roulette
       - |float|
       - Where paths end. 0: as in ``path``, by their throughput. Positive: each path goes on, and each shadow ray is
         traced, with a probability in proportion to the radiance that is expected from it, over that of the pixel times
         this number; what is expected comes from a table of cells, learned from ``2^17`` paths. The best is about 0.2
         times the relative standard deviation of a sample. (Default: measured, together with the keys above; 0 where
         these are all given, where ``cache_samples`` or ``alpha`` is 0, and with ``mode=progressive``)
     * - guide
       - |float|
       - Share, in [0, 1), of directions that come from tables of where light came from, in cells, learned from ``2^19``
         paths; the others come from the BSDF. (Default: measured, 0 or 1/2; 0 where ``roulette`` is)
     * - every_vertex
       - |bool|
       - Use the cache as a control variate at each vertex of the residual path, too, with two queries a vertex.
         (Default: false)
     * - ris
       - |bool|
       - Choose the one traced direction among the ``cache_samples`` that were queried, in proportion to f cos L plus a
         defensive share (resampled importance sampling); MIS goes on with the density of the candidates. It
         paid in one of seven scenes (``mi-neural doc measured``). (Default: false)"""
    + INCIDENT_KEYS
    + SHARED_KEYS
    + INCIDENT_PRESETS
    + r"""
    Channels: ``direct``, ``cache`` (its part of the sum, with α), ``residual`` (RGB each; with visible emission they
    sum to the image of mode ``unbiased``), ``alpha``; ``variance_cache``, ``variance_residual``,
    ``variance_indirect`` (RGB each): sample variances of one camera sample; over the number of samples they are
    the variance of the pixel.

    *Works with* all surfaces and emitters of Mitsuba, RGB variants ``llvm_ad_rgb`` and ``cuda_ad_rgb``. *Leaves out*
    participating media (use ``plain_path``), polarization, spectral rendering, ``blend`` (use ``nirc``).
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
register("nirc_two_level", NIRCTwoLevelIntegrator)
