"""``nvc_direct``: direct light by learned visibility."""

from functools import partial

import drjit as dr
import mitsuba as mi

from mi_neural.caches import presets
from mi_neural.caches.direct import GRID, LOSSES, DirectCache, DirectTraining, albedo
from mi_neural.caches.visibility import VisibilityCache
from mi_neural.integrators.base import refuse_gradients
from mi_neural.integrators.checks import check_scene
from mi_neural.integrators.keys import register
from mi_neural.integrators.lighting import LightSamplingIntegrator, light_sampler_of
from mi_neural.lights import clusters
from mi_neural.lights.sampling import VisibleLights
from mi_neural.lights.table import LightTable
from mi_neural.lights.unshadowed import UnshadowedLights
from mi_neural.render import path as paths
from mi_neural.render import vertex
from mi_neural.render.binding import BoundScene
from mi_neural.render.film import recordable
from mi_neural.render.sampling import PathSampler

MODES = ("sampled", "neural")
CACHES = ("visibility", "radiance")
INITS = ("uniform", "he")
#: Bounces between mirrors from which Russian roulette may end a training path.
RR_DEPTH = 8


class NVCDirectIntegrator(LightSamplingIntegrator):
    r"""
    .. _integrator-nvc_direct:

    Direct light by neural visibility (:monosp:`nvc_direct`)
    --------------------------------------------------------

    Estimates emission, and direct light at the first surface that is not a mirror. Mirrors and glass are followed.
    With ``mode="sampled"`` each shadow ray goes to a light that the ``light_sampler`` chooses, by default one that has
    learned which lights are visible from where, and a BSDF ray is weighted against it: unbiased, whatever was learned.
    With ``mode="neural"`` there are no shadow rays: all lights are summed, each as it would be without shadows, times
    its predicted visibility (the "neural direct illumination" of Bokšanský and Meister 2025),

    .. math:: L = L_e + \sum_k V_k(x) \int f L_k \cos\theta\, d\omega,

    This has no noise at the first vertex, but a bias: shadows are as sharp as the network's grid, parts of a light have
    the same visibility, and glossy lobes are linearly transformed cosines. It is meant for previews.

    .. pluginparameters::

     * - preset
       - |string|
       - ``measured``: the defaults below. ``paper``: the constants as printed, of the ``radiance`` cache, and of the
         ``nvc_lights`` where no ``light_sampler`` is nested. A key that you set overrides the preset. The list
         below has both. (Default: measured)
     * - mode
       - |string|
       - ``sampled`` (unbiased) or ``neural`` (no shadow rays; no more lights than the light sampler has outputs).
         (Default: sampled)
     * - cache
       - |string|
       - ``visibility``, or ``radiance``: the baseline NRC-DI, a network that holds reflected direct light itself and is
         read without shadow rays, for comparison; ``mode`` does not matter then. (Default: visibility)
     * - light_samples
       - |int|
       - Shadow rays per camera sample (``sampled``). They share its BSDF ray and one query of the light sampler's
         network. (Default: 4; with ``preset="paper"`` 1)
     * - max_depth
       - |int|
       - Longest path in segments, mirrors included: 1 shows emitters; with 2, mirrors show emitters only, and
         ``sampled`` has the mean of ``path`` with that depth; -1 means no limit. (Default: -1)
     * - rr_depth
       - |int|
       - Mirrors and glass from which Russian roulette may end a path. (Default: 5)
     * - hide_emitters
       - |bool|
       - Leave out what the camera sees of emitters directly. (Default: false)
     * - light_sampler
       - |emitter|
       - Nested plugin that chooses the light of each shadow ray; ``neural`` needs an ``nvc_lights``. It is trained
         before each image as its own keys say. (Default: an ``nvc_lights`` with this seed and preset)
     * - train_frames
       - |int|
       - Training steps of the ``radiance`` cache before the first image. (Default: 256)
     * - train_steps
       - |int|
       - Training steps of the ``radiance`` cache before each later image. (Default: 1)
     * - train_samples
       - |int|
       - Its points per step, each with one sample of direct light. (Default: 8192)
     * - world_points
       - |float|
       - Share of these points that lie anywhere in the box of what is seen, and reflect as white Lambertians of random
         orientations would; the others lie on surfaces that the camera sees. (Default: 0)
     * - loss
       - |string|
       - Its loss: the squared error, ``relative`` to the squared prediction, or ``squared`` alone. (Default: relative)
     * - first_rate, last_rate
       - |float|
       - Its learning rates, at a place that is new, and at one that has been trained ``rate_steps`` times. (Default:
         0.02, 0.002)
     * - rate_steps
       - |int|
       - Steps in which the rate falls, linearly. (Default: 200)
     * - averaging
       - |float|
       - Share of the old weights in each step of the average that is used; 0: the latest weights. (Default: 0.98)
     * - levels
       - |int|
       - Levels of its hash grid. (Default: 8)
     * - base_resolution
       - |int|
       - Cells of the coarsest level along an axis. (Default: 8)
     * - level_scale
       - |float|
       - Factor of that number from level to level. (Default: 1.5)
     * - init
       - |string|
       - Of its network's weights: ``uniform`` (Dr.Jit's), or ``he``. (Default: uniform)
     * - freeze_cache
       - |bool|
       - Do not train the ``radiance`` cache. (Default: false)
     * - seed
       - |int|
       - Of initial weights and training points. (Default: 0)
     * - channels
       - |string|
       - Extra channels, a comma-separated list of ``visibility`` (predicted, of light number ``light``), ``light``
         (number of a light as it is chosen there, -1 for none; with 1 sample a pixel), ``pmf`` (its probability).
         (Default: none)
     * - light
       - |int|
       - Which light the channel ``visibility`` shows, in the order of the light table; of clustered lights, that of its
         cluster. (Default: 0)

    Constants of ``paper`` / ``measured`` of the ``radiance`` cache, NRC-DI (Bokšanský and Meister 2025, section 4.2:
    network, data and rates of the visibility cache; those of the visibility cache are on the page of ``nvc_lights``),
    and relMSE in ``lamp_bays`` after 256 steps with the one / the other:

    - ``train_frames``: 1 (one step a frame) / 256.
    - ``train_samples``, ``world_points``: 8192, 0.5 / 8192, 0; 0.19 / 0.0063: light in the air in front of a wall
      counts for the wall. What points in the air reflect is not printed.
    - ``loss``: squared / relative; 0.0131 / 0.0063.
    - ``first_rate``, ``last_rate``, ``rate_steps``: 0.05, 0.001, 200 / 0.02, 0.002, 200; 0.0069 / 0.0063. In both
      presets the rate falls with the age of a place, not with that of the network.
    - ``averaging``: none / 0.98; 0.0066 / 0.0063.
    - ``levels``, ``base_resolution``, ``level_scale``: 10, 16, not printed (2 taken) / 8, 8, 1.5; 0.0077 / 0.0063.
    - ``init``: he / uniform; 0.0059 / 0.0063.
    - ``light_samples``: 1 / 4; relMSE times CPU seconds of 128 samples, over that with 4: `lamp_bays` 2.2, staircase2
      2.0, Sponza with 1,024 lamps 1.4.
    - ``mode``: the paper has both; no preset changes it.

    Four features a level, 2^14 entries, two hidden layers of 32 leaky rectifiers (0.01) and a leaky output are the
    paper's in both presets; ours in both are the division by the albedo, the shortcut past the network, and that it
    begins at the scene's mean. The measurements are those of ``mi-neural doc measured``.

    *Works with* all surfaces and emitters of Mitsuba. *Leaves out* light reflected more than once (use ``nirc``),
    participating media (use ``plain_path``), and in ``neural``: textures on lights and the detail of the environment
    (their mean counts), shadows within the environment. What a material's mirror lobe shows of lights (``plastic``) is
    traced in every mode.

    Errors: ``ValueError`` for a key out of range, a scene without emitters, ``neural`` with more lights than outputs.

    .. tabs::
        .. code-tab:: xml

            <integrator type="nvc_direct">
                <string name="mode" value="neural"/>
                <emitter type="nvc_lights" name="light_sampler"> <integer name="outputs" value="32"/> </emitter>
            </integrator>

        .. code-tab:: python

            mi.load_dict({"type": "nvc_direct", "mode": "neural"})
    """

    records = differentiable = False
    direct_only = True
    CHANNELS = {"visibility": 1, "light": 1, "pmf": 1}  # noqa: RUF012
    render_backward = render_forward = refuse_gradients

    def __init__(self, props):
        self.preset = props.get("preset", "measured")
        props.use_preset(self.preset, presets.NeuralVisibility())
        super().__init__(props)
        self.mode = props.get("mode", "sampled")
        self.kind = props.get("cache", "visibility")
        self.light_samples = props.get("light_samples", 1 if self.preset == "paper" else 4)
        self.train_frames = props.get("train_frames", 256)
        self.train_steps = props.get("train_steps", 1)
        self.train_samples = props.get("train_samples", 8192)
        self.freeze_cache = props.get("freeze_cache", False)
        self.seed = props.get("seed", 0)
        self.light = props.get("light", 0)
        self._set_channels(props.get("channels", ""))
        for name, value, known in (("mode", self.mode, MODES), ("cache", self.kind, CACHES)):
            self._check(value in known, f"{name} is '{value}'; give one of: {', '.join(known)}")
        for name, value, least in (("light_samples", self.light_samples, 1), ("train_frames", self.train_frames, 0),
                                   ("train_steps", self.train_steps, 0), ("train_samples", self.train_samples, 4),
                                   ("seed", self.seed, 0), ("light", self.light, 0)):  # fmt: skip
            self._check(value >= least, f"{name} is {value}; it must be at least {least}")
        self.light_sampler = light_sampler_of(props) or mi.load_dict(
            {"type": "nvc_lights", "seed": self.seed, "preset": self.preset}
        )
        self.cache = self._radiance_cache(props)
        self.reset()

    def _radiance_cache(self, props) -> DirectCache:
        """The cache of direct light that the keys describe."""
        init = props.get("init", "uniform")
        self._check(init in INITS, f"init is '{init}'; give one of: {', '.join(INITS)}")
        averaging = props.get("averaging", DirectTraining.ema_decay)
        steps = props.get("rate_steps", DirectTraining.ramp)
        self._check(0 <= averaging <= 1, f"averaging is {averaging}; it must lie in [0, 1]")
        self._check(steps >= 1, f"rate_steps is {steps}; it must be at least 1")
        sizes = {"levels": "n_levels", "level_scale": "per_level_scale", "base_resolution": "base_resolution"}
        grid = {
            "n_levels": props.get("levels", GRID["n_levels"]),
            "per_level_scale": props.get("level_scale", GRID["per_level_scale"]),
            "base_resolution": props.get("base_resolution", GRID["base_resolution"]),
        }
        try:
            training = DirectTraining(
                self.train_samples, averaging, props.get("first_rate", DirectTraining.first_rate),
                props.get("last_rate", DirectTraining.last_rate), steps, loss=props.get("loss", LOSSES[0]),
                world_points=props.get("world_points", DirectTraining.world_points),
            )  # fmt: skip
            trace = partial(direct_records, self.depth_limit)
            return DirectCache(trace, training, self.seed, grid=grid, he=init == "he")
        except ValueError as e:
            message = str(e).removeprefix(f"{self.plugin}: ")
            for key, name in sizes.items():
                message = message.replace(f"{name} is", f"{key} is")
            raise ValueError(f"{self.plugin}: {message}") from None

    @property
    def predicts(self) -> bool:
        """Whether direct light is the sum over lights of what is predicted."""
        return self.kind == "visibility" and self.mode == "neural"

    # -------------------------------------------------------------------------------------------------------------
    # State

    def reset(self) -> None:
        """Forget what was learned; the next image trains anew."""
        super().reset()
        self.cache.reset()
        self.bound = BoundScene()
        self.unshadowed: UnshadowedLights | None = None
        self.only_light: VisibilityCache | None = None  # of a single light, which no light sampler learns
        self.mixed = True  # whether materials have mirror lobes beside others

    def reseed(self, seed: int) -> None:
        self.cache.seed = seed
        super().reseed(seed)

    def statistics(self) -> dict:
        """Facts since the last reset."""
        facts = super().statistics()
        if self.only_light is not None:
            facts |= {"lights": 1, "light_groups": 1} | self.only_light.statistics
            facts["seconds_train"] = facts["seconds_visibility"]
        if self.kind == "radiance":
            facts |= self.cache.statistics
            facts["seconds_train"] += facts["seconds_direct"]
        return facts

    @property
    def untrained(self) -> bool:
        return super().untrained and not self.cache.steps

    def bind(self, scene, sensor, train: bool = True) -> None:
        """Train as the keys say, and have all ready for an image of `scene` as it is now."""
        if not self.bound.knows(scene):
            check_scene(scene, self.plugin)
            if self.bound.parts is not None:
                self.reset()
            self.mixed = has_mixed_materials(scene)
            self.film_state.forget_scene()
            self.bound.changed(scene)
        sensor = recordable(sensor, self.film_state.n_bound)
        self.film_state.n_bound += 1
        with dr.resume_grad():
            self.lights = self.light_sampler.lights(scene, sensor, train)
            if self.kind == "radiance":
                steps = self.train_steps if self.cache.steps else self.train_frames
                self.cache.train(scene, sensor, self.lights, frames=steps if train and not self.freeze_cache else 0)
        if self.lights is None and (self.predicts or self.channels):
            self.lights = self._only_light(scene, sensor, train)
        knows = getattr(self.lights, "field", None) is not None
        needs = "needs an nvc_lights with visibility=true as light_sampler"
        if "visibility" in self.channels:
            self._check(knows, f"the channel 'visibility' {needs}")
            n = self.lights.table.n_lights
            self._check(self.light < n, f"light is {self.light}; the scene has lights 0..{n - 1}")
        if self.predicts:
            self._check(knows, f'mode="neural" {needs}; or use mode="sampled"')
            self._check_single(self.lights)
            with dr.suspend_grad():
                if self.unshadowed is None or self.unshadowed.table is not self.lights.table:
                    self.unshadowed = UnshadowedLights(scene, self.lights.table)
                else:
                    self.unshadowed.refresh()

    def _check_single(self, lights) -> None:
        self._check(
            lights.groups.single,
            f'mode="neural" must know each light by itself, and there are {lights.table.n_lights} lights for '
            f'{lights.groups.n_groups} outputs; use mode="sampled", or raise outputs of the light_sampler (up to 256)',
        )

    def _only_light(self, scene, sensor, train: bool):
        """A light sampler of the scene's single light, which is not worth one elsewhere."""
        with dr.suspend_grad():
            table = LightTable(scene)
            groups = clusters.make_groups(table, 1)
        settings = self.light_sampler
        self._check(getattr(settings, "cache", None) is not None, "one light needs nvc_lights as light_sampler")
        if self.only_light is None:
            known = settings.cache
            self.only_light = VisibilityCache(known.training, seed=self.cache.seed, grid=known.grid, he=known.he)
        steps = settings.train_steps if self.only_light.steps else settings.train_frames
        with dr.resume_grad():
            self.only_light.train(scene, sensor, table, groups, frames=steps if train and not settings.freeze else 0)
        return VisibleLights(table, groups, self.only_light.field)

    # -------------------------------------------------------------------------------------------------------------
    # Rendering

    def estimate(self, scene, lights, field, sampler, ray, settings, active):
        """E[L] = emission + direct light at the first surface that is not a mirror."""
        path = paths.camera_vertex(self, scene, mi.Ray3f(dr.detach(ray)), active)
        path, sampler = paths.follow_mirrors(scene, path, sampler, self.depth_limit, self.rr_depth)
        si, bsdf, active = path.si, path.si.bsdf(), path.active

        # Direct light at the first surface that is not a mirror
        if self.kind == "visibility" and self.mode == "sampled":
            direct, valid = self.sampled(scene, path, sampler)
        else:
            if self.kind == "radiance":
                direct = albedo(si, bsdf, active) * self.cache.query(si.p)
            else:
                direct = self.unshadowed.total(scene, si, bsdf, self.lights.field.query(si.p), active)
            direct += self.mirrored(scene, si, bsdf, sampler, active)
            holes = active & vertex.has_null(bsdf)
            opacity = 1 - dr.mean(bsdf.eval_null_transmission(si, holes))
            valid = dr.select(holes, opacity, dr.select(path.valid, mi.Float(1), 0))
        L = path.L + dr.select(active, path.β * direct, 0)
        return L, valid, self.extra(si, bsdf, sampler, active) if self.channels else {}

    def sampled(self, scene, path, sampler):
        """(direct light, whether the pixel is covered): E = ∫ f Le cos dω, by `light_samples` shadow rays and one BSDF
        ray."""
        n = self.light_samples
        direct = paths.direct_light if n == 1 else partial(paths.several_lights, n)
        found, _ = paths.bounce(scene, self.lights, path, sampler, paths.stratified(sampler), direct=direct)
        return found.direct, paths.advance(path, found).valid

    def mirrored(self, scene, si, bsdf, sampler, active):
        """Emission that the mirror lobes of a material with others beside show."""
        if not self.mixed:
            return mi.Color3f(0)
        ctx = mi.BSDFContext()
        ctx.type_mask = mi.BSDFFlags.Delta
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active)
        weight = vertex.finite(weight, active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
        seen = active & (dr.max(weight) > 0)
        si_next = scene.ray_intersect(si.spawn_ray(si.to_world(bs.wo)), seen)
        return weight * vertex.emission(scene, si_next, seen)

    def extra(self, si, bsdf, sampler, active) -> dict:
        """The channels asked for, at the first surface that is not a mirror."""
        values = {}
        if "visibility" in self.channels:
            group = self.lights.groups.host["label"][self.light]
            values["visibility"] = dr.select(active, self.lights.field.query(si.p)[group], 0)
        if "light" in self.channels or "pmf" in self.channels:
            n, transmits = vertex.receiver(si, bsdf)
            smooth = active & vertex.has_smooth(bsdf)
            choice = self.lights.choose(si, n, transmits, sampler.next_1d(), sampler, mi.UInt32(0), smooth)
            chosen = smooth & (choice.weight > 0)
            values["light"] = dr.select(chosen, mi.Float(choice.index), -1)
            values["pmf"] = dr.select(chosen, choice.pmf, 0)
        return values

    def to_string(self):
        return (
            f"NVCDirectIntegrator[\n  mode = {self.mode},\n  cache = {self.kind},\n"
            f"  light_samples = {self.light_samples},\n  max_depth = {self.max_depth},\n"
            f"  light_sampler = {self.light_sampler.to_string()}\n]"
        )


def has_mixed_materials(scene) -> bool:
    """Whether materials of `scene` have mirror lobes beside others, as far as can be seen from here."""
    shapes = scene.shapes()
    if any(s.bsdf() is None or s.class_name() == "Instance" for s in shapes):
        return True
    flags = [s.bsdf().flags() for s in shapes]
    return any(mi.has_flag(f, mi.BSDFFlags.Smooth) and mi.has_flag(f, mi.BSDFFlags.Delta) for f in flags)


def direct_records(max_depth: int, scene, sensor, lights, n: int, seed):
    """Training points of the radiance cache, where the camera looks: (position, direct light over albedo, valid)."""
    lane = dr.arange(mi.UInt32, n)
    sampler = PathSampler.make(lane, seed, index=lane, scramble=seed)
    ray, _ = sensor.sample_ray(sensor.shutter_open(), sampler.next_1d(), sampler.stratified_2d(0), sampler.next_2d())
    path = paths.start(ray, scene.ray_intersect(ray), mi.Bool(True), max_depth)
    path, sampler = paths.follow_mirrors(scene, path, sampler, max_depth, RR_DEPTH)
    # What mirror lobes show is traced when the cache is queried
    found, sampler = paths.bounce(scene, lights, path, sampler, follow=lambda bs, delta: ~delta)
    si = path.si
    target = (found.L_nee + dr.select(found.delta, 0, found.weight) * found.Le) / albedo(si, si.bsdf(), path.active)
    valid = path.active & dr.all(dr.isfinite(target))
    return mi.Point3f(si.p), mi.Color3f(dr.select(valid, target, 0)), valid


register("nvc_direct", NVCDirectIntegrator)
