"""``nrc``: paths that end in a neural outgoing radiance cache."""

import math
import time

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.caches.field import CacheFileError
from mi_neural.caches.outgoing import OutgoingCache, OutgoingField, OutgoingShape, OutgoingTraining
from mi_neural.integrators.common import SHARED_KEYS, CacheIntegrator, _other_scene
from mi_neural.transport import vertex
from mi_neural.transport.samples import PathSampler
from mi_neural.transport.suffixes import scene_is_glossy, surface_of
from mi_neural.transport.termination import PathSpread

#: Dimensions of the stratified numbers of the first vertex
AA, NEE, BSDF, LOBE, LIGHT = range(5)
#: The constants of a training step in the words of the plugin's keys
KEYS = {"world_share": "world_share", "suffix": "train_suffix", "content": "cache_content",
        "threshold": "spread_threshold", "roughening": "roughening"}  # fmt: skip


class NRCIntegrator(CacheIntegrator):
    def __init__(self, props):
        super().__init__(props)
        self.spread_threshold = props.get("spread_threshold", 0.01)
        self.content = props.get("cache_content", "reflected")
        self._check(self.spread_threshold >= 0, f"spread_threshold is {self.spread_threshold}; it must be 0 or more")
        # A path of infinite spread threshold never asks the cache; its training paths end by the paper's constant
        chosen = {
            "threshold": self.spread_threshold if math.isfinite(self.spread_threshold) else 0.01,
            "content": self.content,
            "suffix": props.get("train_suffix", "spread"),
            "world_share": props.get("world_share", 0.25),
            "unbounded_share": props.get("unbounded_share", 1 / 16),
            "roughening": props.get("roughening", 0.0),
        }
        shared, sizes = self.cache.training, self.cache.shape
        try:
            training = OutgoingTraining(
                n_paths=shared.n_paths, n_vertices=shared.n_vertices, learning_rate=shared.learning_rate,
                ema_decay=shared.ema_decay, **chosen,
            )  # fmt: skip
        except ValueError as e:
            message = str(e)
            for name, key in KEYS.items():
                message = message.replace(f"{name} is", f"{key} is")
            raise ValueError(f"{self.plugin}: {message}") from None
        shape = OutgoingShape(
            n_levels=sizes.n_levels, hashmap_size=sizes.hashmap_size, width=sizes.width, n_hidden=sizes.n_hidden
        )
        self.cache = OutgoingCache(training, shape, seed=self.seed)

    @property
    def needs_cache(self) -> bool:
        return super().needs_cache and math.isfinite(self.spread_threshold)

    @property
    def queries_per_sample(self) -> float:
        return 1.0 if self.needs_cache else 0.0

    # -------------------------------------------------------------------------------------------------------------

    def estimate(self, scene, lights, field, sampler, ray, mixture, active):
        """E[L] = path tracing up to the vertex where the spread exceeds that of the pixel, and the cache there."""
        ctx = mi.BSDFContext()
        cached = self.needs_cache and field is not None
        glossy = scene_is_glossy(scene)
        views = cached and bool({"cache", "density"} & set(self.channels))
        max_depth = mi.UInt32(self.max_depth if self.max_depth >= 0 else 0xFFFFFFFF)
        active = mi.Bool(active) & (max_depth > 0)

        # --------------------- What the camera sees --------------------
        if self.hide:
            pi = self.skip_area_emitters(scene, mi.Ray3f(ray), True, active)
            si = pi.compute_surface_interaction(mi.Ray3f(ray), mi.RayFlags.All, active)
        else:
            si = scene.ray_intersect(ray, active)
        shown = active & (si.is_valid() | (not self.hide))
        L = vertex.emission(scene, si, shown)
        visible = active & si.is_valid() | shown & (dr.max(L) > 0)
        active &= si.is_valid() & (max_depth > 1)

        def is_smooth(si, active):
            return active & si.is_valid() & vertex.has_smooth(si.bsdf())

        smooth = is_smooth(si, active)
        spread = PathSpread.start(dr.width(si.t)).arrive(si, ray, mi.Float(1), mi.Bool(True), smooth)
        asks = smooth & spread.exceeds(self.spread_threshold) if cached else mi.Bool(False)
        view = (surface_of(si, si.bsdf(), smooth, glossy), dr.select(smooth, mi.Color3f(1), 0)) if views else ()
        # Numbers of the first vertex, which spread evenly over the samples of a pixel
        first = [sampler.stratified_1d(LOBE), sampler.stratified_2d(BSDF), sampler.stratified_1d(LIGHT),
                 sampler.stratified_2d(NEE)]  # fmt: skip

        def bounce(depth, ray, si, β, η, L, spread, asks, active, sampler, *view):
            # ------------------- One BSDF sample ----------------------
            bsdf = si.bsdf(ray)
            independent = [sampler.next_1d(), sampler.next_2d(), sampler.next_1d(), sampler.next_2d()]
            u_lobe, u_bsdf, u_light, u_nee = (
                dr.select(depth == 1, a, b) for a, b in zip(first, independent, strict=True)
            )
            bs, weight = bsdf.sample(ctx, si, u_lobe, u_bsdf, active)
            weight = vertex.finite(weight, active)
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            next_ray = si.spawn_ray(si.to_world(bs.wo))
            followed = active & (dr.max(weight) > 0)
            si_next = scene.ray_intersect(next_ray, followed)

            # ---------------------- Direct light ----------------------
            L_nee, Le = vertex.emitted(
                scene, lights, si, bsdf, u_light, u_nee, sampler, active, si_next, bs.pdf, delta, followed
            )
            L += β * (L_nee + weight * Le)

            # --------- Roulette (must cancel out η² to obtain unitless throughput)
            β_next, η_next = β * weight, η * bs.eta
            alive = followed & ~asks & si_next.is_valid() & (depth + 1 < max_depth) & (dr.max(β_next) > 0)
            roulette = depth >= self.rr_depth
            q = dr.minimum(dr.max(β_next) * η_next**2, 0.95)
            alive &= ~roulette | (sampler.next_1d() < q)
            β_next = dr.select(roulette, β_next * dr.rcp(dr.maximum(q, 1e-6)), β_next)

            # --------------- Ask the cache at the next vertex? --------
            goes_on = mi.Bool(alive)
            if cached:
                smooth = is_smooth(si_next, alive)
                if view:
                    new = smooth & ~spread.started
                    view = (
                        dr.select(new, surface_of(si_next, si_next.bsdf(), new, glossy), view[0]),
                        dr.select(new, β_next, view[1]),
                    )
                spread = spread.arrive(si_next, next_ray, bs.pdf, delta, smooth)
                wide = smooth & spread.exceeds(self.spread_threshold)
                if self.content == "reflected":
                    goes_on &= ~wide
                    asks |= wide
                else:  # once more, for direct light; then stay
                    β_next, si_next = dr.select(asks, β, β_next), dr.select(asks, si, si_next)
                    asks |= wide
            return depth + dr.select(alive, 1, 0), next_ray, si_next, β_next, η_next, L, spread, asks, goes_on, \
                sampler, *view  # fmt: skip

        goes_on = active & ~asks if self.content == "reflected" else mi.Bool(active)
        state = (mi.UInt32(1), mi.Ray3f(ray), si, mi.Color3f(1), mi.Float(1), L, spread, mi.Bool(asks), goes_on,
                 sampler, *view)  # fmt: skip
        depth, ray, si, β, _, L, _, asks, _, sampler, *view = dr.while_loop(
            state, lambda *state: state[8], bounce, label="path prefix"
        )

        # ---------------------- The cache at its end ------------------
        cache = mi.Color3f(0)
        if cached:
            surface = surface_of(si, si.bsdf(ray), asks, glossy)
            cache = dr.select(asks, β * field.query(*surface.inputs()), 0)
        channels = {"traced": L, "cached": cache, "depth": dr.select(visible, mi.Float(depth), 0)}
        if {"cache", "density"} & set(self.channels):
            channels |= {"cache": mi.Color3f(0), "density": mi.Float(0)}
        if view:
            surface, β_view = view
            seen = dr.max(β_view) > 0
            channels["cache"] = dr.select(seen, β_view * field.query(*surface.inputs()), 0)
            channels["density"] = dr.select(seen, field.density_at(surface.position), 0)
        return L + cache, visible, channels

    # -------------------------------------------------------------------------------------------------------------

    def measure_query(self, n: int = 2**18) -> float:
        """Nanoseconds per cache query. Also kept for :meth:`statistics`."""
        field = self.cache.field
        if field is None:
            raise RuntimeError(f"{self.plugin}: there is no cache yet; render an image or call train() first")

        @dr.freeze
        def run(field, seed):
            sampler = PathSampler.make(dr.arange(mi.UInt32, n), seed)
            low, inv = field.box_min, field.box_inv_extent
            x = low + mi.Vector3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d()) / inv
            normal, w = (mi.warp.square_to_uniform_sphere(sampler.next_2d()) for _ in range(2))
            return field.query(x, normal, w, mi.Color3f(sampler.next_1d()), sampler.next_1d())

        times = []
        with dr.suspend_grad():
            for k in range(7):
                dr.sync_thread()
                t0 = time.perf_counter()
                dr.eval(run(field, mi.UInt32(k)))
                dr.sync_thread()
                times.append(time.perf_counter() - t0)
        self.state.ns_per_query = float(np.median(times[2:])) / n * 1e9
        return self.state.ns_per_query

    def save_cache(self, path) -> None:
        """Write the trained cache to `path`, whole or not at all."""
        if self.cache.field is None:
            raise RuntimeError(f"{self.plugin}: there is no cache to save yet; render an image or call train() first")
        self.cache.field.save(
            path, plugin="nrc", scene=self.state.signature, content=self.content,
            statistics=dict(self.cache.statistics),
        )  # fmt: skip

    def load_cache(self, path, scene=None) -> None:
        """Go on from a cache file. With `scene`, or once a scene was rendered: refuse a cache of another scene.

        Raises `CacheFileError` (a ``ValueError``).
        """
        field, header = OutgoingField.load(path)
        if field.shape != self.cache.shape:
            raise CacheFileError(f"'{path}' holds a cache of {field.shape}, this integrator has {self.cache.shape}; "
                                 "give it the same sizes")  # fmt: skip
        if header.get("content", self.content) != self.content:
            raise CacheFileError(f"'{path}' holds {header['content']} light; set cache_content to {header['content']}")
        if scene is not None:
            self._ready(scene, self._sensor(scene, 0), train=False)
        known = self.state.signature
        if known is not None and header.get("scene") != known:
            raise CacheFileError(_other_scene(path))
        self.cache.adopt(field)
        self.state.loaded = (path, header.get("scene"))

    def to_string(self):
        return (
            f"NRCIntegrator[\n  spread_threshold = {self.spread_threshold},\n  cache_content = {self.content},\n"
            f"  max_depth = {self.max_depth},\n"
            f"  training = {self.cache.training},\n  network = {self.cache.shape},\n"
            f"  frames trained = {self.cache.steps}\n]"
        )


NRCIntegrator.CHANNELS = {"traced": 3, "cached": 3, "cache": 3, "depth": 1, "density": 1}
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
    a record. One in 16 runs on without (``unbounded_share``). The reflectance is factored out of the records and
    multiplied back.

    .. pluginparameters::

     * - spread_threshold
       - |float|
       - The constant c: 0 asks the cache at the first surface that is not a mirror, infinity never (``nrc`` is a path
         tracer). An SDK defines :math:`a_0` as :math:`4\pi |x_0-x_1|^2 / |\cos\theta_1|`, 158 times as large: give
         158 times its constant. (Default: 0.01)
     * - cache_content
       - |string|
       - What the cache holds. ``reflected``: all reflected light. ``indirect``: without direct light, which is traced
         at the terminal vertex too: less bias, for one more bounce. (Default: reflected)
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
         by many reflections, and the cache starts too dark. (Default: 0.0625)
     * - roughening
       - |float|
       - Share of each surface's BSDF that becomes Lambertian with each bounce of a training path (none at its first
         vertex, mirrors or glass): less noise in the records, some bias. (Default: 0)
    """
    + SHARED_KEYS.strip("\n")
    + r"""

    Channels: ``traced``, ``cached`` (RGB each; with visible emission in ``traced`` they sum to the image), ``cache``
    (RGB: the cache seen directly at the first vertex), ``depth`` (segments up to the end of the path: a heat map of
    where paths end), ``density`` (training records per frame near the first vertex, in a cell of 1/32 of the box).
    ``statistics()["loss"]`` is the loss of the latest training frame, ``cache.history`` holds those of all.

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
