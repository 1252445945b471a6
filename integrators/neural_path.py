"""``neural_path``: at each vertex the outgoing cache, the incident cache or another bounce."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from mi_neural.caches.blend import where_active
from mi_neural.caches.incident import reflect
from mi_neural.caches.outgoing import RATE
from mi_neural.caches.pair import PairCache
from mi_neural.integrators.keys import SHARED_KEYS, register
from mi_neural.integrators.outgoing import OUTGOING_KEYS, OutgoingIntegrator
from mi_neural.render import prefix, vertex
from mi_neural.render.surface import scene_is_glossy, surface_of

#: Queries a camera sample, at its first vertex and at its end; fewer where only one of them is queried, more where the
#: end is in the incident cache.
QUERIES = 2.0


class NeuralPathIntegrator(OutgoingIntegrator):
    def __init__(self, props):
        super().__init__(props)
        self.cache_samples = props.get("cache_samples", 4)
        self._check(self.cache_samples > 0, f"cache_samples is {self.cache_samples}; it must be at least 1")
        self._check(self.cache.blend == "ema", f"blend is '{self.cache.blend}'; neural_path needs 'ema'")
        shared, sizes = self.cache.training, self.cache.shape
        self._check(shared.n_paths > 1, f"train_samples is {shared.n_paths}; training paths come in pairs, at least 2")
        incident = replace(shared, learning_rate=shared.learning_rate / RATE)
        self.cache = PairCache(self.outgoing_training(), incident, sizes, self.seed, n_queries=self.cache_samples)

    @property
    def caches(self) -> tuple[str, ...]:
        return ("outgoing", "incident")

    def settings(self, spp: int) -> tuple:
        return (float(spp),)

    @property
    def queries_per_sample(self) -> float:
        return QUERIES if self.needs_cache else 0.0

    # -------------------------------------------------------------------------------------------------------------

    def estimate(self, scene, lights, field, sampler, ray, settings, active):
        """E[L] = Le + w L_o(x_1) + (1 - w) [direct light + what a path gathers that ends in either cache].

        `field`: a :class:`~mi_neural.caches.pair.PairField`; None: path tracing. The first share w depends on nothing
        but the place and the number of samples of the finished image, so E[L] is right where both estimates are.
        """
        (n_samples,) = settings
        cached = self.needs_cache and field is not None
        glossy = scene_is_glossy(scene)

        def stop(si, spread, smooth, first, sampler):
            share, incident = field.accuracy.choose(si.p, vertex.facing(si), n_samples, smooth)
            incident &= ~mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Delta)  # its reflections are not in the cache
            wide = smooth & ~first & spread.exceeds(self.spread_threshold)
            ends = wide & (sampler.next_1d() < field.accuracy.stops(si.p, n_samples, wide))
            return share, ends, incident & (first | wide) & ~ends, sampler

        end, sampler = prefix.trace(
            self, scene, lights, sampler, ray, active, stop if cached else None, glossy, look=cached
        )
        path, zero = end.path, mi.Color3f(0)
        channels = {"traced": path.L, "cached": zero, "cache": zero, "density": mi.Float(0),
                    "depth": dr.select(path.valid, mi.Float(path.depth), 0),
                    "share": end.share if cached else mi.Float(0)}  # fmt: skip
        if not cached:
            return path.L, path.valid, channels

        def outgoing(*inputs):
            return tuple(field.outgoing.query(*inputs))

        shows = bool({"cache", "density"} & set(self.channels))
        seen = (dr.max(end.β_first) > 0) & ((end.share > 0) | shows)
        at_first = end.β_first * mi.Color3f(*where_active(seen, end.first.inputs(), outgoing, 3))
        bsdf = path.si.bsdf(path.ray)
        at_end = surface_of(path.si, bsdf, end.ends, glossy)
        at_end = mi.Color3f(*where_active(end.ends, at_end.inputs(), outgoing, 3))

        lit = end.ends_lit
        point = mi.Point3f(path.si.p), vertex.facing(path.si)
        features = where_active(
            lit, point, lambda x, n: tuple(field.incident.encode(x, n)), field.incident.shape.n_encoded
        )
        by_incident, sampler = reflect(
            field.incident, list(features), path.si, bsdf, self.cache.n_queries, sampler, lit
        )
        cached = end.share * at_first + path.β * (dr.select(end.ends, at_end, 0) + dr.select(lit, by_incident, 0))
        channels |= {"cached": cached, "cache": at_first}
        if shows:
            channels["density"] = dr.select(seen, field.outgoing.density_at(end.first.position), 0)
        return path.L + cached, path.valid, channels

    def to_string(self):
        return (
            f"NeuralPathIntegrator[\n  spread_threshold = {self.spread_threshold},\n"
            f"  max_depth = {self.max_depth},\n"
            f"  training = {self.cache.training},\n  network = {self.cache.shape},\n"
            f"  frames trained = {self.cache.steps},\n  plan = {self.state.plan or self.plan_mode}\n]"
        )


NeuralPathIntegrator.CHANNELS = {
    "traced": 3, "cached": 3, "cache": 3, "depth": 1, "share": 1, "density": 1
}  # fmt: skip
NeuralPathIntegrator.__doc__ = (
    r"""
    .. _integrator-neural_path:

    Path tracer that ends in neural caches (:monosp:`neural_path`)
    --------------------------------------------------------------

    Estimates all light with little noise and a small bias that vanishes as samples are added. It has a cache of
    outgoing radiance (as ``nrc``) and one of incident radiance (as ``nirc``), trained on the same paths, and decides at
    each vertex by their errors, which are measured while training, without a reference and without further rays.

    Training paths are traced in pairs from the same first vertex, so that two independent estimates T, T' of the same
    radiance exist. Over such pairs the mean of (A - T)(A - T') is the squared bias of a cache's answer A
    (:math:`b_o^2`; of the incident cache :math:`b_i^2`, its noise :math:`v_i`) and that of (T - T')²/2 the noise v of
    tracing on, all by cells of 1/16 of the box. For an image of N samples a pixel:

    - First vertex: what is traced either ends right there, in the incident cache, or goes on. It is mixed with the
      outgoing cache's answer by the weight of least squared error, :math:`v/N / (v/N + b_o^2)` if it goes on. Of the
      two, that one is taken whose mix has the smaller error in equal time.
    - Later vertices, once the path is wide (``spread_threshold``): the outgoing cache with probability
      :math:`1/(1 + N m^2/v)`, m being its mean error over a region; else incident cache or another bounce as above.

    So the first samples show the caches, more samples trust them less, and :math:`E[L_o]` tends to the path-traced
    radiance.

    .. pluginparameters::

     * - spread_threshold
       - |float|
       - Constant c of the spread test a > c a_0 of later vertices (Müller et al. 2021, sec. 3.4); infinity: path
         tracing. (Default: 0.01)
     * - cache_samples
       - |int|
       - Directions in which the incident cache is queried at the end of a path. (Default: 4)"""
    + OUTGOING_KEYS
    + SHARED_KEYS
    + r"""
    Channels: ``traced``, ``cached`` (RGB each; with visible emission in ``traced`` they sum to the image), ``cache``
    (RGB: the outgoing cache seen directly at the first vertex), ``share`` (its weight there), ``depth`` (segments up to
    the end of the path), ``density`` (training records per frame near the first vertex).

    *Works with* all surfaces and emitters of Mitsuba, RGB variants ``llvm_ad_rgb`` and ``cuda_ad_rgb``. *Leaves out*
    participating media (use ``volpath``), polarization, spectral rendering, ``blend`` (use ``nrc``).

    Errors: ``ValueError`` for a key out of range, a scene without emitters, sensors or with media;
    :class:`~mi_neural.caches.field.CacheFileError` for cache files.

    .. tabs::
        .. code-tab:: xml

            <integrator type="neural_path"/>

        .. code-tab:: python

            image = mi.render(scene, integrator=mi.load_dict({"type": "neural_path"}), spp=16)
    """
)
register("neural_path", NeuralPathIntegrator)
