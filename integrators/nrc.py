"""``nrc``: paths that end in a neural outgoing radiance cache."""

import drjit as dr
import mitsuba as mi

from mi_neural.caches import presets
from mi_neural.caches.blend import OutgoingBlend, sigma_channels
from mi_neural.caches.outgoing import OutgoingCache
from mi_neural.caches.outgoing_field import OutgoingShape
from mi_neural.integrators.blending import Blending, blending_of
from mi_neural.integrators.keys import BLEND_KEYS, SHARED_KEYS, older_name, register
from mi_neural.integrators.outgoing import OUTGOING_KEYS, OutgoingIntegrator
from mi_neural.render import prefix
from mi_neural.render.kernels import end_kernel
from mi_neural.render.surface import scene_is_glossy


class NRCIntegrator(OutgoingIntegrator):
    def __init__(self, props):
        self.preset = props.get("preset", "measured")
        sources = presets.RadianceCacheGuide(), presets.RadianceCaching(), presets.ReliabilityWeighted()
        props.use_preset(self.preset, *sources)
        super().__init__(props)
        self.content = props.get("cache_content", "reflected")
        self.cache = OutgoingCache(
            self.outgoing_training(), OutgoingShape.like(self.cache.shape), self.seed, blend=self.cache.blend,
            reliability=self.cache.reliability,
        )  # fmt: skip

    def blending(self, props) -> Blending:
        return blending_of(props, "reliability" if self.plan_mode == "everything" else "ema")

    @property
    def caches(self) -> tuple[str, ...]:
        return ("outgoing",)

    @property
    def queries_per_sample(self) -> float:
        return 1.0 if self.needs_cache else 0.0

    # -------------------------------------------------------------------------------------------------------------

    def estimate(self, scene, lights, field, sampler, ray, settings, active):
        """E[L] = path tracing up to the vertex where the spread exceeds that of the pixel, and the cache there."""
        cached, glossy = self.needs_cache and field is not None, scene_is_glossy(scene)

        def stop(path, spread, smooth, first, sampler):
            wide = smooth & spread.exceeds(self.spread_threshold)
            never = mi.Bool(False)
            return mi.Float(0), *((wide, never) if self.content == "reflected" else (never, wide)), sampler

        looks = cached and bool({"cache", "density"} & set(self.channels))
        end, sampler = prefix.trace(
            self, scene, lights, sampler, ray, active, stop if cached else None, glossy, looks, self.walk
        )
        path, cache, shown = end.path, mi.Color3f(0), sigma_channels(None, None, None)
        if cached:
            surface = self.walk.surface(path, end.queried, glossy)
            end_kernel(path.L, path.β, path.valid, path.depth, end.queried, surface, end.first, end.β_first)
            cache = dr.select(end.queried, path.β * field.query(*surface.inputs()), 0)
            shown = sigma_channels(field, surface.position, surface.normal)
        channels = {"traced": path.L, "cached": cache, "depth": dr.select(path.valid, mi.Float(path.depth), 0)}
        channels |= {k: dr.select(end.queried, v, 0) for k, v in shown.items()}
        channels |= {"cache": mi.Color3f(0), "density": mi.Float(0)}
        if looks:
            seen = dr.max(end.β_first) > 0
            channels["cache"] = dr.select(seen, end.β_first * field.query(*end.first.inputs()), 0)
            plain = field.field if isinstance(field, OutgoingBlend) else field
            channels["density"] = dr.select(seen, plain.density_at(end.first.position), 0)
        return path.L + cache, path.valid, channels

    def to_string(self):
        return (
            f"NRCIntegrator[\n  spread_threshold = {self.spread_threshold},\n  cache_content = {self.content},\n"
            f"  max_depth = {self.max_depth},\n"
            f"  training = {self.cache.training},\n  network = {self.cache.shape},\n"
            f"  frames trained = {self.cache.steps},\n  plan = {self.state.plan or self.plan_mode}\n]"
        )


NRCIntegrator.CHANNELS = {
    "traced": 3, "cached": 3, "cache": 3, "depth": 1, "density": 1, "sigma": 1, "preference": 1
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

    The cache holds the light that a surface reflects, direct light included (``cache_content``). It does not hold
    emission, which is counted at the vertex before with its MIS weight.

    Training paths begin as those of pixels do, or at the records of earlier frames. They go on beyond the terminal
    vertex until they have become as wide once more. There the cache itself is read (self-training). Each vertex is a
    record. One path in 4, and each in scenes with media, runs on to its natural end (``unbounded_share``). The
    reflectance is factored out of the records and multiplied back.

    .. pluginparameters::

     * - preset
       - |string|
       - ``measured``: the defaults below. ``paper``: the constants as printed. A key that you set overrides the preset.
         The list below has both. (Default: measured)
     * - spread_threshold
       - |float|
       - The constant c. With 0 the cache is queried at the first surface that is not a mirror, with infinity never
         (``nrc`` is a path tracer). An SDK defines :math:`a_0` as :math:`4\pi |x_0-x_1|^2 / |\cos\theta_1|`, 158
         times as large: give 158 times its constant. (Default: 0.01)
     * - cache_content
       - |string|
       - What the cache holds. ``reflected``: all reflected light. ``indirect``: without direct light, which is traced
         at the terminal vertex too: less bias, for one more bounce. (Default: reflected)"""
    + OUTGOING_KEYS
    + BLEND_KEYS
    + SHARED_KEYS
    + r"""
    Constants of ``paper`` / ``measured``, and the measurement that led from one to the other. The former are those of
    Müller et al. 2021 with a hash grid for the position, and of AMD's guide "FSR Radiance Caching" (``learning_rate``,
    ``ema_decay``, ``spread_threshold``, ``inputs``); for ``reliability`` and the keys that begin with it those of
    Klepikov et al.:

    - ``learning_rate``, ``last_rate``: 0.002, 1 (it does not fall) / 0.06, 0.1 / ajar door, 100 frames: FLIP 0.212 with
      0.01, 0.160 or 0.184 with 0.03; 0.06 with half the paths: trimmed relMSE 0.0090 to 0.0069.
    - ``train_steps``, ``train_samples``, ``train_records``: 4, 8192, 16384 / 1, 2048 (on a GPU 8192), three times as
      many / half the paths and twice the rate learn as well or better in equal time. The paper has as many paths as
      give 65,536 records a frame, the guide 1 to 5 % of the pixels as records; this number of paths is not printed.
    - ``width``, ``hidden_layers``: 64, 2 / 32, 2 / Cornell box: relMSE 0.0041 / 0.0038.
    - ``epsilon``: 0.01 / 1 / stairwell, 300 steps: relative squared error 0.070 / 0.066. Cornell box: relMSE 0.0045 /
      0.0038.
    - ``unbounded_share``: 1/16 / 1/4 / ajar door, 300 steps: 0.97 / 1.00 of its light.
    - ``world_share``: 0 (all paths start at the camera) / 0.25 / Cornell box, one view: relMSE 0.0033 / 0.0038; the
      quarter is there for what leaves the view.
    - ``inputs``: all four / those that the scene needs / Cornell box: relMSE 0.0048 / 0.0038.
    - ``ema_decay``, ``ema_debiased``: 0.99, true / 0.99, false / Cornell box: relMSE 0.0034 / 0.0038.
    - ``spread_threshold``: 0.01 in both presets.
    - ``reliability``: correlation / evidence / steady flicker of the blend, over that of the average, 50 / 1.00.
    - ``reliability_decay``, ``reliability_warm_up``, ``reliability_kappa``: 0.9, 128, 4 in both presets; λ counts
      frames, not records.
    - Not printed, so ours in both: ``train_vertices``, ``train_frames``, ``roughening`` (the guide recommends it),
      ``levels``, ``hashmap_size``, the grid's resolutions, ``reliability_epsilon``, ``reliability_resolution``.
    - Without a key and ours in both: spherical harmonics of degree 3 for normal and view (the paper: one-blob with 4
      bins each; squared error after 300 steps 0.180 / 0.139), biases in the network (the paper: none), the shortcut
      past it, points looked up above their surface.

    The measurements are those of ``mi-neural doc measured`` and of the docstrings in ``mi_neural.caches``. All of the
    preset, after 200 steps of 2048 paths, has a relMSE of 0.011 in the Cornell box.

    Channels: ``traced``, ``cached`` (RGB each; with visible emission in ``traced`` they sum to the image), ``cache``
    (RGB: the cache seen directly at the first vertex), ``depth`` (segments up to the end of the path: a heat map of
    where paths end), ``density`` (training records
    per frame near the first vertex, in a cell of 1/32 of the box), ``sigma`` and ``preference`` (of ``blend``: weight
    of the network being trained where the cache was queried, and 1 where it exceeds 1/2). ``statistics()["loss"]`` is
    the loss of the latest training frame, ``cache.history`` holds those of all.

    In participating media paths also end at points where a medium scatters. The cache holds the radiance that is
    scattered there towards the path, :math:`\int p L d\omega`, p being the phase function; the medium's albedo is in
    the throughput. The spread of a path has no angle there. No path ends at rough glass around a medium. ``roughening``
    is refused. Measured: ``mi-neural doc media``.

    *Works with* all surfaces, emitters and media of Mitsuba, RGB variants ``llvm_ad_rgb`` and ``cuda_ad_rgb``. *Leaves
    out* phase functions of microflakes (``sggx``: use ``volpath``), gradients in media (use ``prbvolpath``),
    polarization, spectral rendering, and a limit to the number of bounces inside the cache (use ``path``). Sharp
    reflections seen by way of a rough surface are blurred.

    Errors: ``ValueError`` for a key out of range, a scene without emitters or sensors;
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
register("nrc", lambda props: older_name(props) or NRCIntegrator(props))
