"""``restir_di``: direct light by reuse of light samples over pixels and frames."""

import math

import drjit as dr
import mitsuba as mi

from mi_neural.caches import presets
from mi_neural.emitters.common import edits_of
from mi_neural.integrators import restir_reuse as reuse
from mi_neural.integrators import restir_samples as samples
from mi_neural.integrators.base import Nonfinite, refuse_gradients
from mi_neural.integrators.checks import check_film, check_scene, check_spp, refuse_medium_of
from mi_neural.integrators.keys import register
from mi_neural.integrators.lighting import light_sampler_of
from mi_neural.integrators.restir_past import Past, camera_of, nothing, reproject, slim_surface
from mi_neural.lights.sampling import PowerLights
from mi_neural.lights.table import LightTable
from mi_neural.render import path as paths
from mi_neural.render import vertex
from mi_neural.render.film import Area, camera_rays, coverage, put_in_reach, recordable, sensor_of
from mi_neural.render.frozen import LOCK, call, can_freeze, can_freeze_scene, is_recording
from mi_neural.render.sampling import PathSampler

COMBINATIONS = ("unbiased", "biased")
CANDIDATES = ("light", "nvc")
NVC_WHERE = ("everywhere", "disoccluded")
#: What a pixel takes in memory while a frame is rendered (measured on two cores: 470 to 570 bytes).
PIXEL_BYTES = 640


class _State:
    """What changes from frame to frame. Apart, because a frozen function is recorded anew whenever an attribute of the
    integrator that it belongs to changes."""

    def __init__(self):
        self.frames: dict = {}  # recorded functions
        self.freeze = True
        self.chooser = self.power = self.edits = None
        self.key: tuple = ()
        self.reset()

    def reset(self) -> None:
        self.past: Past | None = None
        self.past_power: PowerLights | None = None
        self.past_camera: tuple | None = None
        self.frame = 0
        self.nonfinite = Nonfinite()


class ReSTIRDirectIntegrator(mi.SamplingIntegrator):
    __doc__ = r"""
    .. _integrator-restir_di:

    Direct light by reservoir resampling over pixels and frames (:monosp:`restir_di`)
    ---------------------------------------------------------------------------------

    Estimates emission and direct light at the first surface, as ``path`` does with ``max_depth = 2``, for the frames of
    a running sequence: each pixel keeps one light sample, chosen among candidates of its own, what it kept in the frame
    before and what its neighbours keep (Bitterli et al. 2020). The default has no bias while geometry and materials do
    not change; the camera may move and the lights may change. With :math:`y` the kept sample (a light, and two numbers
    :math:`u` that choose a point on it),

    .. math:: L_o = L_e + w_b \frac{f L_e \cos\theta}{p_b} + w_l \frac{f L_e V \cos\theta}{p(y \mid u)} \, W_y, \qquad
              W_y = \frac{1}{\hat p(y)} \sum_i m_i(y_i) \, \hat p(y_i) \, W_i,

    and :math:`W_i = 1 / p_i` of a candidate (Bitterli et al. 2020, eq. 6). Samples are reused as :math:`u`, by which a
    light of any kind can be sampled again from elsewhere without a Jacobian. The emission that a BSDF ray meets is a
    second estimate with its own MIS weight :math:`w_b = 1 - w_l` (one BSDF ray against ``initial_candidates`` lights in
    proportion to power). It is not reused: sharp reflections of lights look as in ``path``.

    ``unbiased``: the target :math:`\hat p` includes visibility and is tested anew wherever a sample goes; :math:`m_i`
    are the balance heuristic over frames and defensive pairwise weights over pixels (Bitterli 2022; Lin et al. 2022),
    which have less noise than 1/Z. Up to 5 + 2 ``spatial_samples`` rays a pixel. ``biased``: :math:`\hat p` without
    visibility and :math:`m_i = M_i / \sum M` (1/M), 4 rays; too dark at shadows and edges. Without
    ``candidate_shadow_ray`` :math:`\hat p` knows no visibility in either, and one shadow ray a pixel goes to what is
    shown: 3 rays, and ``unbiased`` remains so.

    One frame is one sample a pixel. A ``render`` call with ``spp`` samples renders so many frames and returns their
    mean. The noise of these frames is correlated, so ``restir_di`` is for one or few samples a pixel.

    .. pluginparameters::

     * - preset
       - |string|
       - ``measured``: the defaults below. ``paper``: the constants as printed, of the ``nvc_lights``, too, where no
         ``light_sampler`` is nested. A key that you set overrides the preset. The list below has both. (Default:
         measured)
     * - initial_candidates
       - |int|
       - Light samples that a pixel chooses from in each frame. (Default: 8)
     * - candidate_shadow_ray
       - |bool|
       - Whether the chosen one of these sends a shadow ray, and is left out if it is blocked. (Default: true)
     * - candidates
       - |string|
       - ``light``: in proportion to power; ``nvc``: as the nested ``light_sampler`` chooses, ``nvc_lights`` if there is
         none. (Default: nvc where a ``light_sampler`` is nested, else light)
     * - nvc_where
       - |string|
       - ``everywhere``, or ``disoccluded``: only in pixels that the frame before does not know, ``light`` candidates
         elsewhere. (Default: everywhere)
     * - light_sampler
       - |emitter|
       - Nested plugin that chooses the candidates: ``nvc_lights``, ``tree_lights``, ``power_lights`` or
         ``uniform_lights``. (Default: none, see ``candidates``)
     * - history
       - |float|
       - Largest confidence of the sample kept in the frame before, in frames; 0: no reuse over frames. (Default: 20)
     * - spatial_samples
       - |int|
       - Number of neighbours whose samples a pixel reuses; 0: no reuse over pixels. (Default: 4)
     * - spatial_radius
       - |float|
       - They lie in a disk of this radius, in pixels; -1: a 24th of the film's height, 4 to 32. At 320x180, 8 pixels
         gave relMSE 0.23, 32 gave 0.31. (Default: -1)
     * - normal_threshold
       - |float|
       - Smallest cosine between the normals of two surfaces that share samples. (Default: 0.9)
     * - depth_threshold
       - |float|
       - Largest difference of their distances from the camera, relative. (Default: 0.1)
     * - combination
       - |string|
       - ``unbiased`` or ``biased``, see above. (Default: unbiased)
     * - max_depth
       - |int|
       - Of a scene made for ``path``. Light reflected once is all that is rendered: -1 and numbers above 2 do what 2
         does, and warn; 0 and 1 are refused. (Default: 2)
     * - rr_depth
       - |int|
       - Of a scene made for ``path``; no path is long enough for it to matter. (Default: 5)
     * - hide_emitters
       - |bool|
       - Leave out what the camera sees of emitters directly. (Default: false)

    Constants of ``paper`` / ``measured``, and the measurement that led from one to the other. The former are those of
    the ReSTIR that Bokšanský and Meister 2025 compare with (sections 3.1 and 4.1):

    - ``initial_candidates``, ``history``: 8, 20 in both presets.
    - ``spatial_radius``: 32 / by the film's height / 320x180: relMSE 0.31 / 0.23.
    - ``candidate_shadow_ray``: true, with ``nvc`` candidates false / true / ``lamp_bays`` with these: trimmed relMSE
      0.57 / 0.10, 63 / 79 ms a frame; ``glossy_hall`` 14 / 1.8: what is in shadow is kept and reused.
    - ``nvc_where``: the paper has both, and recommends disoccluded / everywhere, so that ``candidates`` means all of
      them; disoccluded costs 1.5 % of a frame (``mi-neural doc speed``).
    - Not printed, so ours in both: ``spatial_samples``, ``normal_threshold``, ``depth_threshold``, ``combination``.

    State lives from call to call; another scene, sensor or film size starts anew, as ``reset()`` does by hand. A moved
    or reshaped *object* leaves a trace that fades over ``history`` frames (type ``reset()``).

    *Works with* all surfaces and emitters of Mitsuba, any reconstruction filter, RGB variants ``llvm_ad_rgb`` and
    ``cuda_ad_rgb``. Motion is followed for pinhole cameras (``perspective``); other sensors look at the same pixel of
    the frame before. *Leaves out* reflected light (use ``nirc``), mirrors and glass beyond the emission that they show
    directly, media (use ``plain_path``), nesting in ``aov`` or ``moment``, and films that do not fit memory at one
    sample a pixel (some 570 bytes each).

    Errors: ``ValueError`` for a key out of range, a scene without emitters, sensors or with media.

    .. tabs::
        .. code-tab:: xml

            <integrator type="restir_di">
                <string name="combination" value="unbiased"/>
                <emitter type="nvc_lights" name="light_sampler"/>
            </integrator>

        .. code-tab:: python

            integrator = mi.load_dict({"type": "restir_di", "candidates": "nvc"})
            for frame in range(100):
                image = mi.render(scene, integrator=integrator, spp=1, seed=frame)
    """

    def __init__(self, props):
        super().__init__(props.props)
        self.hide, self.max_depth = props.get("hide_emitters", False), 2
        self._check_depth(props.get("max_depth", 2))
        props.get("rr_depth", 5)
        self.light_sampler = light_sampler_of(props)
        self.candidates = props.get("candidates", "light" if self.light_sampler is None else "nvc")
        self.preset = props.get("preset", "measured")
        more = [presets.ReSTIRWithVisibility()] if self.candidates == "nvc" else []
        props.use_preset(self.preset, presets.ReSTIR(), *more)
        self.candidate_shadow_ray = props.get("candidate_shadow_ray", True)
        self.initial_candidates = props.get("initial_candidates", 8)
        self.history = props.get("history", 20.0)
        self.spatial_samples = props.get("spatial_samples", 4)
        self.spatial_radius = props.get("spatial_radius", -1.0)
        self.normal_threshold = props.get("normal_threshold", 0.9)
        self.depth_threshold = props.get("depth_threshold", 0.1)
        self.combination = props.get("combination", "unbiased")
        self.nvc_where = props.get("nvc_where", "everywhere")
        self._check(self.initial_candidates >= 1,
                    f"initial_candidates is {self.initial_candidates}; it must be at least 1")  # fmt: skip
        self._check(self.history >= 0, f"history is {self.history}; give 0 (no reuse over frames) or more")
        self._check(self.spatial_samples >= 0,
                    f"spatial_samples is {self.spatial_samples}; give 0 (no reuse over pixels) or more")  # fmt: skip
        self._check(
            0 < self.spatial_radius < math.inf or self.spatial_radius == -1,
            f"spatial_radius is {self.spatial_radius}; give -1 (by the film) or a number greater than 0",
        )
        self._check(-1 <= self.normal_threshold <= 1,
                    f"normal_threshold is {self.normal_threshold}; it is a cosine, in [-1, 1]")  # fmt: skip
        self._check(self.depth_threshold > 0, f"depth_threshold is {self.depth_threshold}; it must be greater than 0")
        for key, allowed in (("combination", COMBINATIONS), ("candidates", CANDIDATES), ("nvc_where", NVC_WHERE)):
            value = getattr(self, key)
            self._check(value in allowed, f"{key} is '{value}'; give one of: {', '.join(allowed)}")
        self._check(self.light_sampler is None or self.candidates == "nvc",
                    "a light_sampler is nested but candidates is 'light', which does not ask it; "
                    "set candidates to 'nvc' or leave the light_sampler out")  # fmt: skip
        self.unbiased = self.combination == "unbiased"
        # Whether the target knows visibility; else one shadow ray goes to what is shown
        self.visible_target = self.unbiased and self.candidate_shadow_ray
        self.state = _State()

    def _check(self, ok: bool, message: str) -> None:
        if not ok:
            raise ValueError(f"restir_di: {message}")

    def _check_depth(self, asked: int) -> None:
        """Refuse a `max_depth` that leaves out direct light; say what another one leaves out here."""
        self._check(
            asked == -1 or asked >= 2,
            f"max_depth is {asked}; it renders direct light: give 2, or take path with that max_depth",
        )
        if asked != 2:
            mi.Log(mi.LogLevel.Warn, f"mi_neural: restir_di renders light reflected once (max_depth 2, not {asked}); "
                   "neural_path, nirc and plain_path render all")  # fmt: skip

    def reset(self) -> None:
        """Forget the frames before, and what a light sampler has learned. Compiled kernels are kept."""
        self.state.reset()
        if self.state.chooser is not None:
            self.state.chooser.reset()

    # -------------------------------------------------------------------------------------------------------------
    # From frame to frame

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """The mean of the next `spp` frames (0: as many as the sampler's sample count says)."""
        sensor = sensor_of(scene, sensor, "restir_di")
        refuse_medium_of(sensor, "restir_di")
        check_spp(spp, "restir_di")
        check_film(sensor, "restir_di", PIXEL_BYTES)
        if is_recording():
            raise RuntimeError(
                "restir_di: inside a function frozen by dr.freeze it would reuse the first call's samples for ever; "
                "render it outside of that function, or use plain_path there"
            )
        spp = spp or sensor.sampler().sample_count()
        seed = int(seed[0]) if hasattr(seed, "__len__") else int(seed)
        film = sensor.film()
        with LOCK, dr.suspend_grad():
            film.prepare([])
            block = film.create_block()
            block.set_coalesce(False)
            for _ in range(spp):
                block.put(*self._next_frame(scene, sensor, seed))
            film.put_block(block)
            result = film.develop() if develop else mi.TensorXf()
            if evaluate:
                dr.eval(result)
            return result

    def _next_frame(self, scene, sensor, seed: int):
        """Render one frame: (positions, values) for the film's block."""
        s, film = self.state, sensor.film()
        area = Area.of(sensor)
        # The parts, not the scene, which may hold this integrator; they must live as long as the surfaces kept of them
        key = (*scene.shapes(), *scene.emitters(), sensor, area)
        if len(key) != len(s.key) or any(a is not b and a != b for a, b in zip(key, s.key, strict=True)):
            check_scene(scene, "restir_di")
            s.reset()
            s.frames.clear()
            s.power = None  # it has the lights of the scene before
            s.key, s.freeze, s.edits = key, can_freeze_scene(scene), None

        lights, facts = self._lights(scene, recordable(sensor, s.frame))
        camera, pinhole = camera_of(sensor)
        if s.past is None or s.past_power.table.n_lights != s.power.table.n_lights:
            s.past = nothing(area.n_pixels)
            s.past_power, s.past_camera = s.power, camera
        s.alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        facts = (facts, _facts(s.past_power.table), pinhole, area, s.alpha)
        numbers = mi.UInt32(seed & 0xFFFFFFFF), dr.opaque(mi.UInt32, s.frame)
        rays = None
        if s.freeze and not can_freeze(sensor):
            pixel = dr.arange(mi.UInt32, area.n_pixels)
            rays = camera_rays(sensor, area, pixel, _numbers(pixel, *numbers, 0x6A09E667))[:3]
            dr.eval(rays)
        frame = self._frame_of(area, pinhole)
        if s.freeze and facts not in s.frames:
            s.frames[facts] = dr.freeze(frame, auto_opaque=False)
        pos, values, s.past, n_bad = call(
            s.frames, facts, frame, scene, sensor if rays is None else None, rays, lights, s.power, s.past_power,
            s.past, s.past_camera, *numbers,
        )  # fmt: skip
        s.nonfinite.add(n_bad)
        s.past_power, s.past_camera = s.power, camera
        s.frame += 1
        return pos, values

    def _lights(self, scene, sensor):
        """See that `state.power` is that of the scene now. Returns what chooses the candidates, and what a recorded
        function takes for granted of it."""
        s = self.state
        if s.chooser is None:
            s.chooser = self.light_sampler or mi.load_dict(
                {"type": "nvc_lights", "preset": self.preset} if self.candidates == "nvc" else {"type": "power_lights"}
            )
        lights = s.chooser.lights(scene, sensor)
        if lights is None:  # a single light, which light samplers do not watch
            s.edits = s.edits or edits_of(scene)
            if s.edits.changed():
                s.power = None
            lights = s.power or PowerLights(LightTable(scene))
        if s.power is None or s.power.table is not lights.table:
            s.power = lights if isinstance(lights, PowerLights) else PowerLights(lights.table)
        facts = (type(lights).__name__, _facts(lights.table), getattr(lights, "candidates", None))
        if (g := getattr(lights, "groups", None)) is not None:
            facts += (g.n_groups, tuple(g.kind), g.single, g.search_steps)
        return lights, (*facts, getattr(lights, "field", None) is None)

    # -------------------------------------------------------------------------------------------------------------
    # One frame

    def _frame_of(self, area: Area, pinhole: bool):
        """A function that renders one frame, to be recorded."""
        border, size, width, height = area.border, area.size, area.width, area.height

        def render_frame(scene, sensor, rays, lights, power, past_power, past, past_camera, seed, frame):
            pixel = dr.arange(mi.UInt32, area.n_pixels)
            sampler = _numbers(pixel, seed, frame, 0x5BF03635)
            if rays is None:
                ray, w_camera, pos, sampler = camera_rays(sensor, area, pixel, sampler)
            else:
                ray, w_camera, pos = rays

            # ------------------- What the camera sees ---------------------
            L, valid, si, usable, sampler = self.first_surface(scene, ray, sampler, power)

            # ------------- Where that was in the frame before -------------
            before, found = reproject(self, si, past, past_camera, size, border, pixel, pinhole, usable)

            # ----------------- Initial candidates, one ray ----------------
            kept = samples.initial(self, scene, lights, power, si, found, sampler, usable)

            # --------------------- Reuse over frames ----------------------
            if self.history > 0:
                kept = reuse.frames(self, scene, power, past_power, si, kept, past, before, found, sampler)
            dr.eval(kept, si, usable, L, valid, w_camera, pos, sampler)

            # --------------------- Reuse over pixels ----------------------
            if self.spatial_samples > 0:
                kept = reuse.pixels(self, scene, power, si, kept, usable, pixel, width, height, sampler)

            # -------------------------- Shade -----------------------------
            f, p_light = samples.contribution(self, scene, power, si, kept.index, kept.uv, usable & (kept.W > 0))
            shown = usable & (kept.W > 0)
            if not self.visible_target:  # else the target knows it
                shown &= samples.visible(scene, si, p_light, shown)
            L = w_camera * (L + vertex.finite(f * kept.W, shown))
            ok = dr.all(dr.isfinite(L))
            L = dr.select(ok, L, 0)
            values = [L.x, L.y, L.z]
            if self.state.alpha:
                values.append(dr.select(ok, coverage(valid), 0))
            values.append(dr.select(ok, mi.Float(1), 0))
            pos, values = put_in_reach(area, area.corner(pixel) + 0.5 if area.box else pos, values)
            pos = pos + mi.Point2f(mi.ScalarPoint2f(area.offset))
            past = Past(kept, si, usable)
            dr.eval(pos, values, past, ok)
            return pos, values, past, dr.count(~ok)

        return render_frame

    def first_surface(self, scene, ray, sampler, power):
        """What the camera sees: emission, and that which a BSDF ray meets, weighted against light samples.

        Returns (radiance so far, coverage, surface, whether it takes light samples, sampler).
        """
        path = paths.camera_vertex(self, scene, ray, mi.Bool(True))
        found, sampler = paths.bounce(scene, power, path, sampler, direct=self.emission_met)
        valid = paths.advance(path, found).valid
        L = path.L + path.β * found.direct
        return L, valid, slim_surface(path.si), vertex.is_smooth(path.si, path.active), sampler

    def emission_met(self, scene, power, path, bsdf, found, numbers, sampler, alone=None):
        """As `paths.direct_light`: no light sample, and the share of the BSDF ray in the emission that it met."""
        table, si, delta = power.table, path.si, found.delta
        hit, emits = table.index_of(scene, found.si, found.followed)
        ds = mi.DirectionSample3f(scene, found.si, vertex.reference_point(si.p, si.n))
        pdf_light = table.pdf(scene, si, hit, found.si, ds, emits & ~delta)
        share = dr.select(delta, 1, 1 - samples.light_share(self, power, hit, pdf_light, found.bs.pdf, emits))
        Le = found.si.emitter(scene, emits).eval(found.si, emits)
        return mi.Color3f(0), dr.select(emits, Le * share, 0), sampler

    # -------------------------------------------------------------------------------------------------------------

    render_backward = render_forward = refuse_gradients
    plugin, direct_only = "restir_di", True

    def statistics(self) -> dict:
        """Facts since the last reset: frames, samples that were not finite, and what the light sampler says of itself.
        """
        facts = {} if self.state.chooser is None else self.state.chooser.statistics()
        return {"frames": self.state.frame, "nonfinite": int(self.state.nonfinite),
                "seconds_train": facts.get("seconds_visibility", 0.0), **facts}  # fmt: skip

    def sample(self, scene, sampler, ray, medium=None, active=True):
        raise RuntimeError("restir_di renders whole frames and cannot be nested in another integrator; use plain_path")

    def aov_names(self):
        return []

    def to_string(self):
        return (
            f"ReSTIRDirectIntegrator[\n  candidates = {self.candidates} ({self.initial_candidates}),\n"
            f"  history = {self.history},\n  spatial_samples = {self.spatial_samples} in {self.spatial_radius} px,\n"
            f"  combination = {self.combination},\n  frames = {self.state.frame}\n]"
        )


def _numbers(pixel, seed, frame, salt: int) -> PathSampler:
    """Random numbers of a frame."""
    scramble, _ = mi.sample_tea_32(pixel, seed, 4)
    stream, _ = mi.sample_tea_32(seed, frame, 4)
    return PathSampler.make(pixel, stream ^ salt, index=frame, scramble=scramble)


def _facts(table) -> tuple:
    """What a recorded function takes for granted of a light table."""
    return (table.n_lights, table.any_flat, table.all_flat, table.all_plain, tuple(table.kinds))


register("restir_di", ReSTIRDirectIntegrator)
