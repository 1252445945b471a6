"""``neural_path``: the cache at the first surface as far as it is right, and at the end of paths."""

from __future__ import annotations

import math
import time

import drjit as dr
import mitsuba as mi

from mi_neural.caches.accuracy import MeasuredCache
from mi_neural.caches.blend import where_active
from mi_neural.caches.outgoing_field import OutgoingShape
from mi_neural.estimators.spread import grown
from mi_neural.integrators.keys import SHARED_KEYS, register
from mi_neural.integrators.outgoing import OUTGOING_KEYS, OutgoingIntegrator
from mi_neural.render import prefix
from mi_neural.render.frozen import locked
from mi_neural.render.kernels import end_kernel
from mi_neural.render.surface import scene_is_glossy

#: Queries a camera sample, at its first surface and at its end; of an image that will be denoised at the end alone.
QUERIES, QUERIES_DENOISED = 2.0, 1.0
#: Share of its training paths that run on without self-training. Of a denoised image of 32 samples, FLIP over that with
#: a quarter: veach-bidir 0.89, veach-ajar, living room and staircase 0.99, Cornell box 1.04 (manual, measured).
DENOISED_UNBOUNDED = 0.5
#: Constants of :func:`denoised_threshold`: the factor of N b², training steps, and the least b² that is believed.
ENDS, YOUNG, LEAST_BIAS = 0.3, 60.0, 1e-3
#: A cache that is trained by time stays out of images until it has so many steps. Denoised images of 16 samples have
#: over the squared error of `path` after 5, 10, 20, 40, 80 steps: veach-ajar 4.4 to 8.2, 2.5 to 8.4, 1.5 to 1.8, 0.7 to
#: 2.0, 0.5 to 0.6; living room 1.1 to 1.2, 0.9, 0.8 to 0.9, 0.8, 0.8; Cornell box 1.1, 0.6, 0.6, 0.6, 0.5 (manual,
#: measured).
LEAST_STEPS = 24
#: Training may take so many times the seconds that it is given, to have these steps.
LONGER = 1.4


def denoised_threshold(mean_bias, steps, spp):
    """Spread threshold of an image of `spp` samples that will be denoised, by a cache of so many training `steps`: the
    larger one of ``0.3 spp b²`` and, which counts after few steps, ``(spp b² (60 / steps)^4)^1.5``.

    `mean_bias` is b², the cache's squared bias. With `spp` times as little noise as one sample has, a bias counts `spp`
    times as much. Form and numbers fit six scenes after 40 and 150 steps, with 4, 16 and 48 samples
    (studies/spread_threshold.py).
    """
    expected = spp * dr.maximum(mean_bias, LEAST_BIAS)
    young = expected * dr.square(dr.square(YOUNG / steps))
    return dr.maximum(ENDS * expected, young * dr.sqrt(young))


class NeuralPathIntegrator(OutgoingIntegrator):
    def __init__(self, props):
        super().__init__(props)
        self.denoised = props.get("denoised", False)
        n = self.cache.training.n_paths
        self._check(n > 1, f"train_samples is {n}; training paths come in pairs, at least 2")
        # With `denoised` only the mean bias is read. Without cells a step of 13 to 17 ms of CPU would take 0.07 ms less
        # (cornell_box, veach-ajar; 2026-11-28), but a cache file would fit either denoised images or others
        self.cache = MeasuredCache(self.outgoing_training(), OutgoingShape.like(self.cache.shape), self.seed)

    def default_unbounded(self, props) -> float:
        return DENOISED_UNBOUNDED if props.get("denoised", False) else super().default_unbounded(props)

    def default_unbounded_in_media(self, props) -> float:
        return 1.0 if props.get("denoised", False) else super().default_unbounded(props)

    @property
    def caches(self) -> tuple[str, ...]:
        return ("outgoing",)

    @property
    def queries_per_sample(self) -> float:
        return (QUERIES_DENOISED if self.denoised else QUERIES) if self.needs_cache else 0.0

    @property
    def left_out(self) -> bool:
        """Whether images are traced without the cache, which had no time to learn."""
        return self.state.hurried and self.cache.steps < LEAST_STEPS

    @locked
    def train_seconds(self, scene, seconds: float, sensor=0, progress=None) -> dict:
        """Train for about `seconds` of wall time, longer by a factor of `LONGER` if `LEAST_STEPS` take that long. A
        cache that can not have them stays out of images until it has. Returns :meth:`statistics`."""
        start = time.perf_counter()
        self.bind(scene, self._sensor(scene, sensor), train=False)
        missing = 0 if self.freeze_cache or not self.needs_cache else max(0, LEAST_STEPS - self.cache.steps)
        if missing:
            self.state.hurried = True
            needed = missing * self.seconds_of_step(scene, sensor)
            if needed > LONGER * seconds:
                return self.statistics()
            if needed > seconds - (time.perf_counter() - start):
                return self.train(scene, max(0, LEAST_STEPS - self.cache.steps), sensor, progress)
        return super().train_seconds(scene, seconds - (time.perf_counter() - start), sensor, progress)

    def seconds_of_step(self, scene, sensor) -> float:
        """Seconds of a training step, by the second of two."""
        self.train(scene, 1, sensor)
        dr.sync_thread()
        start = time.perf_counter()
        self.train(scene, 1, sensor)
        dr.sync_thread()
        return time.perf_counter() - start

    def statistics(self) -> dict:
        return super().statistics() | ({"cache_left_out": True} if self.left_out else {})

    def settings(self, spp: int) -> tuple:
        """Samples of the finished image, the spread threshold, and training steps of the cache."""
        if self.left_out:
            return (1.0 if self.denoised else math.inf), math.inf, 1
        threshold = self.spread_threshold if self.denoised else grown(self.spread_threshold, spp)
        return float(spp), threshold, max(1, self.cache.steps)

    def expected_bias(self, spp: int) -> float:
        """Squared relative bias of an image of `spp` samples that is not denoised, as far as the cache shows it at the
        first surface; 0 where nothing was measured."""
        if self.denoised or self.left_out or not self.needs_cache or self.cache.field is None:
            return 0.0
        return self.cache.queried.grid.expected_bias(spp)

    # -------------------------------------------------------------------------------------------------------------

    def estimate(self, scene, lights, field, sampler, ray, settings, active):
        """E[L] = Le + w L_o(x_1) + (1 - w) [direct light + what a path gathers that ends in the cache when it is wide].

        `field`: a :class:`~mi_neural.caches.accuracy.MeasuredField`; None: path tracing. The share w depends on nothing
        but the place and the number of samples of the finished image, and is 0 for an image that will be denoised.
        """
        spp, threshold, steps = settings
        cached, glossy = self.needs_cache and field is not None, scene_is_glossy(scene)
        shows = bool({"cache", "density"} & set(self.channels))
        mixes = cached and not self.denoised
        if cached and self.denoised:
            threshold = dr.maximum(threshold, denoised_threshold(field.grid.mean_bias, steps, spp))
            typical = field.field.typical_density()

        def stop(path, spread, smooth, first, sampler):
            c, place = threshold, self.walk.place(path)
            if self.denoised:  # what was learned from few records is wrong more often, and a denoiser keeps it
                c = c * dr.maximum(typical / dr.maximum(field.field.density_at(place[0]), 1e-30), 1)
            share = field.grid.share(*place, spp, smooth) if mixes else mi.Float(0)
            return share, smooth & ~first & spread.exceeds(c), mi.Bool(False), sampler

        looks = mixes or (cached and shows)
        end, sampler = prefix.trace(
            self, scene, lights, sampler, ray, active, stop if cached else None, glossy, look=looks, walk=self.walk
        )
        path, zero = end.path, mi.Color3f(0)
        channels = {"traced": path.L, "cached": zero, "cache": zero, "density": mi.Float(0),
                    "depth": dr.select(path.valid, mi.Float(path.depth), 0),
                    "share": end.share if mixes else mi.Float(0)}  # fmt: skip
        if not cached:
            return path.L, path.valid, channels

        def query(active, surface):
            return mi.Color3f(*where_active(active, surface.inputs(), lambda *inputs: tuple(field.query(*inputs)), 3))

        last = self.walk.surface(path, end.ends, glossy)
        first = [end.share, end.β_first, end.first] if looks else []
        end_kernel(path.L, path.β, path.valid, path.depth, end.ends, last, *first)
        cached = dr.select(end.ends, path.β * query(end.ends, last), 0)
        if looks:
            seen = (dr.max(end.β_first) > 0) & ((end.share > 0) | shows)
            channels["cache"] = end.β_first * query(seen, end.first)
            cached += end.share * channels["cache"]
        if shows:
            channels["density"] = dr.select(seen, field.field.density_at(end.first.position), 0)
        channels["cached"] = cached
        return path.L + cached, path.valid, channels

    def to_string(self):
        return (
            f"NeuralPathIntegrator[\n  denoised = {self.denoised},\n  spread_threshold = {self.spread_threshold},\n"
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

    Path tracer that ends in a neural cache (:monosp:`neural_path`)
    ---------------------------------------------------------------

    Estimates all light with little noise and a small bias that vanishes as samples are added. It is the integrator to
    take where no reason speaks for another. It has a cache of outgoing radiance (as ``nrc``), and measures while
    training how wrong the cache is, without a reference and without further rays.

    Training paths are traced in pairs from the same first vertex, so that two independent estimates T, T' of the same
    radiance exist. Over such pairs the mean of (A - T)(A - T') is the squared bias :math:`b^2` of the cache's
    prediction A, and that of (T - T')²/2 the noise v of tracing on, both by cells of 1/16 of the box. For an image of N
    samples a pixel:

    - First surface: the cache's prediction is mixed with what is traced, by the weight of least squared error,
      :math:`v/N / (v/N + b^2)`.
    - Later vertices: the path ends in the cache where it is wide. The threshold c of the spread test grows with N, so
      that many samples trace further before they end.

    So an image of few samples mainly shows the cache. With more samples its weight falls, and :math:`E[L_o]` tends to
    the path-traced radiance. A denoiser removes noise, but no bias: for an image that will be denoised, set
    ``denoised``. ``mi-neural`` sets it with ``--denoise``.

    .. pluginparameters::

     * - denoised
       - |bool|
       - The image will be denoised: the first surface does not show the cache, and ``spread_threshold`` is raised to
         :math:`0.3 N b^2` and, after few training steps t, to :math:`(N b^2 (60/t)^4)^{3/2}` where that is more. b² is
         the mean of the scene, at least 0.001. Where fewer training records lie than is usual, it is raised by that
         factor. (Default: false)
     * - spread_threshold
       - |float|
       - Constant c of the spread test a > c a_0 of later vertices (Müller et al. 2021, sec. 3.4), raised to N/256 where
         that is more (with ``denoised`` as said there); infinity: path tracing. (Default: 0.01)"""
    + OUTGOING_KEYS
    + SHARED_KEYS
    + r"""
    An image that must be rendered in a given time (``train_seconds``, ``mi-neural render --seconds``) is path-traced if
    there is no time for 24 training steps, because a younger cache adds more error than it removes. ``statistics()``
    then has ``cache_left_out``.

    Channels: ``traced``, ``cached`` (RGB each; with visible emission in ``traced`` they sum to the image), ``cache``
    (RGB: the outgoing cache seen directly at the first vertex), ``share`` (its weight there), ``depth`` (segments up to
    the end of the path), ``density`` (training records per frame near the first vertex).

    In participating media paths also end at points where a medium scatters. The cache holds the radiance that is
    scattered there towards the path, :math:`\int p L d\omega`, p being the phase function; the medium's albedo is in
    the throughput. The spread of a path has no angle there. No path ends at rough glass around a medium. ``roughening``
    is refused. Measured: ``mi-neural doc media``.

    *Works with* all surfaces, emitters and media of Mitsuba, RGB variants ``llvm_ad_rgb`` and ``cuda_ad_rgb``. *Leaves
    out* phase functions of microflakes (``sggx``: use ``volpath``), gradients in media (use ``prbvolpath``),
    polarization, spectral rendering, and predictions by the weights being trained (``blend`` of ``nrc``).

    Errors: ``ValueError`` for a key out of range, a scene without emitters or sensors;
    :class:`~mi_neural.caches.field.CacheFileError` for cache files.

    .. tabs::
        .. code-tab:: xml

            <integrator type="neural_path"/>

        .. code-tab:: python

            image = mi.render(scene, integrator=mi.load_dict({"type": "neural_path"}), spp=16)
    """
)
register("neural_path", NeuralPathIntegrator)
