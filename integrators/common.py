"""What integrators with a cache share: keys, the life of a frame, passes, statistics, cache files."""

from __future__ import annotations

import math
import time
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural import plan
from mi_neural.caches.field import CacheFileError
from mi_neural.integrators import cache_files, gradients, planning
from mi_neural.integrators.base import Nonfinite
from mi_neural.integrators.checks import FILM_VALUES, check_scene
from mi_neural.integrators.learning import LearningIntegrator
from mi_neural.integrators.lighting import light_sampler_of
from mi_neural.render.binding import BoundScene
from mi_neural.render.film import Area, recordable
from mi_neural.render.frozen import locked, undisturbed
from mi_neural.render.sampling import PathSampler
from mi_neural.render.walk import SURFACES, MediaWalk

#: Frames that `train_frames = -1` trains at least and at most.
SETTLE_FRAMES = (128, 400)


class _State:
    """What changes from image to image. Apart, because a frozen function is recorded anew whenever an attribute of the
    integrator that it belongs to changes; this object it takes as a whole."""

    def __init__(self):
        self.ns_per_query = math.nan
        self.measured: dict = {}  # of the scene
        self.plan: plan.ScenePlan | None = None  # of the scene that was rendered last
        self.bound = BoundScene()
        self.reset()

    def reset(self) -> None:
        self.signature = None
        self.loaded: tuple | None = None  # file and scene of a cache that was read
        self.lights = None  # what chooses lights now; None: the scene itself
        self.images = 0
        self.queries = 0.0
        self.image_open = False
        self.begun = False  # whether the training before the first image was begun, and interrupted
        self.hurried = False  # whether the time for training was too short for a cache that is of use


class CacheIntegrator(LearningIntegrator):
    """Base of the integrators that train a cache of incident radiance. Subclasses give `estimate`.

    The state lives from one ``render`` call to the next; another scene starts it anew.
    """

    #: Numbers of a pixel while an image is made: colour, alpha, weight, and copies of them.
    PIXEL_BYTES = 4 * FILM_VALUES
    #: Where gradients come from if no key says it.
    GRADIENT = "cache"
    #: Whether the plan may choose a light sampler where none is nested.
    CHOOSES_LIGHTS = False
    #: Whether paths may end at rough glass around a medium.
    ENDS_AT_WINDOWS = False

    def __init__(self, props):
        super().__init__(props)
        self.walk = SURFACES
        self.train_steps = props.get("train_steps", 1)
        self.freeze_cache = props.get("freeze_cache", False)
        self.gradient = props.get("gradient", self.GRADIENT)
        self._check(self.gradient in gradients.GRADIENTS,
                    f"gradient is '{self.gradient}'; give one of: {', '.join(gradients.GRADIENTS)}")  # fmt: skip
        self._check(self.train_steps >= 0, f"train_steps is {self.train_steps}; it must be 0 or more")
        self._set_channels(props.get("channels", ""))
        self.light_sampler = self.nested_sampler = light_sampler_of(props)
        if self.nested_sampler is not None:
            self.given["light_sampler"] = self.nested_sampler.plugin
            if self.plan_mode == "everything":
                self.nested_sampler.plan_mode = self.plan_mode
        self.state = _State()
        self.published = None  # see _publish()
        self.reset()

    # -------------------------------------------------------------------------------------------------------------
    # To be given by the plugin

    def measure_scene(self, scene, sensor) -> None:
        """Measure, once per scene, what settings depend on; results go to ``state.measured``."""

    @property
    def needs_cache(self) -> bool:
        """Whether the settings, in the scene of the plan, can lead to a query at all."""
        cached = self.state.plan is None or self.state.plan.modelled("cache")
        return cached and (self.max_depth < 0 or self.max_depth > 2)

    @property
    def queries_per_sample(self) -> float:
        return 0.0

    def follow(self, other: CacheIntegrator, scene, sensor) -> None:
        """Render with what `other` has bound, whose cache this integrator was given, and train nothing. `other` counts
        the samples that are not finite."""
        self.state.lights, self.film_state.nonfinite = other.bound_lights, other.film_state.nonfinite
        if not self.state.measured:
            self.measure_scene(scene, self._view(sensor))

    def forget_scene(self) -> None:
        """Forget what was measured of the scene that was bound, and what was recorded for it."""
        self.film_state.forget_scene()
        self.state.measured = {}

    @property
    def bound_lights(self):
        return self.state.lights

    @property
    def bound_field(self):
        return self.cache.queried if self.needs_cache else None

    @property
    def trains(self) -> bool:
        first = self.cache.steps == 0 and self.train_frames != 0
        return self.needs_cache and not self.freeze_cache and (first or self.train_steps > 0)

    # -------------------------------------------------------------------------------------------------------------
    # State

    def reset(self) -> None:
        """Forget what was learned; the next image trains anew. Compiled kernels are kept."""
        self.cache.reset()
        self.state.reset()
        self.film_state.nonfinite = Nonfinite()
        if self.light_sampler is not None:
            self.light_sampler.reset()

    def reseed(self, seed: int) -> None:
        """As :meth:`reset`, and learn by the random numbers of another `seed` from now on."""
        self.cache.seed = seed
        if self.light_sampler is not None:
            self.light_sampler.reseed(seed)
        self.reset()

    def bind(self, scene, sensor, train: bool = True) -> None:
        """See that there is a cache of this scene, trained as far as the keys say."""
        view = self._view(sensor)
        known, signature = self.state.bound.parts, self.state.signature
        if self.state.bound.changed(scene) or signature is None:
            try:
                self._begin(scene, known is not self.state.bound.parts)
                if self.state.plan is None or known is not self.state.bound.parts:
                    planning.follow(self, planning.make_plan(self, scene, view))
            except BaseException:  # Ctrl-C, too: what was begun is begun anew with the next image, whatever its scene
                refused = self.state.signature == signature
                self.state.bound.parts, self.state.signature = (known, signature) if refused else (None, None)
                raise
        if self.light_sampler is not None:
            # Settings are measured with lights chosen as they will be; an image rendered in several calls is one frame
            learn = (train and not self.state.image_open) or not self.state.measured
            with dr.suspend_grad():
                self.state.lights = self.light_sampler.lights(scene, view, train=learn)
        if self.renders_media:
            self.bind_media(scene, sensor, self.state.bound)
        self.cache.recordable = self.film_state.scene_records(scene)
        if not self.needs_cache:
            if not self.state.measured:
                self.measure_scene(scene, view)
            return
        with dr.resume_grad():
            self.fit_paths(sensor)
            if self.cache.field is None:
                self.cache.start(scene, view, self.state.lights)
            if not self.state.measured:
                with dr.suspend_grad():
                    self.measure_scene(scene, view)
            if train and not self.freeze_cache and not self.state.image_open:
                if self.state.images == 0 and (self.cache.steps == 0 or self.state.begun):
                    self._train_first(scene, view)
                else:
                    self.cache.train(scene, view, self.state.lights, frames=self.train_steps)

    def bind_media(self, scene, sensor, bound: BoundScene) -> None:
        known_media, known_camera, forgotten = self.media, self.camera_medium_id, self.film_state.n_forgotten
        super().bind_media(scene, sensor, bound)
        self.check_media()
        another = self.media is not known_media or self.camera_medium_id != known_camera
        if another or (self.media is not None and self.film_state.n_forgotten > forgotten):
            self.walk = SURFACES
            if self.media is not None:
                self.walk = MediaWalk(self.media, self.camera_medium, self.ENDS_AT_WINDOWS)
            self.cache.walk = self.walk
            if self.media is not known_media:
                self.cache.forget_media()
            self.cache.clear_recordings()

    def check_media(self) -> None:
        """Refuse settings that cannot be kept where the bound scene has participating media."""

    def _begin(self, scene, is_another: bool) -> None:
        """Begin with a scene: refuse it, or see what it is."""
        check_scene(scene, self.plugin, self.renders_media)
        if self.state.signature is not None:
            self.reset()
        signature = cache_files.scene_signature(scene)
        if self.state.loaded is not None and self.state.loaded[1] != signature:
            raise CacheFileError(cache_files.other_scene(*self.state.loaded[:1]))
        self.state.signature = signature
        if is_another:
            self.forget_scene()
            self.cache.clear_recordings()

    @property
    def caches(self) -> tuple[str, ...]:
        """What may be asked for light, as a :class:`~mi_neural.plan.Request` names it."""
        return ("incident",)

    def make_plan(self, scene, sensor=0) -> plan.ScenePlan:
        """What will be built in `scene`, what is left out, and why. Changes nothing."""
        sensor = self._sensor(scene, sensor)
        check_scene(scene, self.plugin, self.renders_media)
        return planning.make_plan(self, scene, self._view(sensor))

    def _publish(self) -> None:
        """Show Dr.Jit the cache as an attribute, once it no longer changes: then a function of the user's that renders
        with this integrator can be frozen."""
        self.published = None if self.trains else self.bound_field

    def _view(self, sensor):
        """What is learned with in the place of `sensor`: other rays of it each time, where it cannot be recorded."""
        return recordable(sensor, self.cache.seed * 0x9E3779B9 + self.cache.steps)

    def _train_first(self, scene, view, progress=None) -> None:
        auto, done, self.state.begun = self.train_frames < 0, self.cache.steps, True
        frames, least, most = (max(0, n - done) for n in (self.train_frames, *SETTLE_FRAMES))
        self.cache.train(scene, view, self.state.lights, frames=None if auto else frames, at_least=least, at_most=most,
                         progress=progress)  # fmt: skip
        self.state.begun = False

    @locked
    def train_first(self, scene, sensor=0, progress=None) -> dict:
        """Train now as the first image would (`train_frames`), if nothing was learned yet, or go on where that was
        interrupted. Returns the statistics."""
        sensor = self._sensor(scene, sensor)
        self.bind(scene, sensor, train=False)
        if self.needs_cache and not self.freeze_cache and (self.cache.steps == 0 or self.state.begun):
            self._train_first(scene, self._view(sensor), progress)
        self._publish()
        return self.statistics()

    @locked
    def train(self, scene, frames: int, sensor=0, progress=None) -> dict:
        """Train `frames` frames now. `progress` is called with (done, total). Returns :meth:`statistics`."""
        sensor = self._sensor(scene, sensor)
        self.bind(scene, sensor, train=False)
        if self.needs_cache and not self.freeze_cache:
            self.cache.train(scene, self._view(sensor), self.state.lights, frames=frames, progress=progress)
        self._publish()
        return self.statistics()

    @locked
    def train_seconds(self, scene, seconds: float, sensor=0, progress=None) -> dict:
        """Train for about `seconds` of wall time. Returns :meth:`statistics`."""
        sensor = self._sensor(scene, sensor)
        self.bind(scene, sensor, train=False)
        if self.needs_cache and not self.freeze_cache:
            self.cache.train(scene, self._view(sensor), self.state.lights, seconds=seconds, progress=progress)
        self._publish()
        return self.statistics()

    def train_fraction(self, seconds: float) -> float:
        """Share of a one-shot budget that is best spent on training before the first sample."""
        return 0.0 if self.freeze_cache or not self.needs_cache else 0.35

    def plan_samples(self, spp: int | None) -> None:
        """Say how many samples a pixel the finished image will have, when it is rendered in several calls."""
        if spp is None:
            self.state.image_open = False
        self.film_state.planned_spp = spp

    @contextmanager
    def previewing(self):
        """Inside, images show what has been learned so far: they train nothing and count for nothing."""
        known = self.state.images, self.state.queries, self.state.image_open
        self.state.image_open = True
        try:
            yield
        finally:
            self.state.images, self.state.queries, self.state.image_open = known

    @locked
    def prepare(self, scene, sensor=0, spp: int = 1) -> None:
        """Compile all that a render call with `spp` needs. What was learned so far stays as it is."""
        sensor = self._sensor(scene, sensor)
        images, queries = self.state.images, self.state.queries
        untouched = self.cache.field is None
        known_lights = self.light_sampler is not None and self.light_sampler.statistics().get("visibility_steps")
        self.bind(scene, sensor, train=False)
        state = self.cache.checkpoint() if self.needs_cache and not untouched else None
        try:
            if self.needs_cache and not self.freeze_cache:
                for _ in range(3):  # the first recordings of a frozen function differ from what it then replays
                    self.cache.train_frame(scene, self._view(sensor), self.state.lights)
            with dr.suspend_grad():
                for _ in range(2):
                    dr.eval(self._render(scene, sensor, 1, spp))
            dr.sync_thread()
            if self.needs_cache and math.isnan(self.state.ns_per_query):
                self.measure_query()
        finally:
            if self.needs_cache:
                self.cache.rollback(state)
            self.state.images, self.state.queries = images, queries
            if self.light_sampler is not None and not known_lights:
                self.light_sampler.reset()

    def statistics(self) -> dict:
        """Facts since the last reset: training (see :class:`IncidentCache`), queries, non-finite samples."""
        s = dict(self.cache.statistics)
        film = self.film_state.statistics()
        s["nonfinite"] += film.pop("nonfinite")
        s.update(film)
        s["queries"] = int(self.state.queries)
        s["images"] = self.state.images
        s.update(self.state.measured)
        s.update(self.cache.measured())
        if self.light_sampler is not None:
            s.update(self.light_sampler.statistics())
            s["seconds_train"] += s.get("seconds_visibility", 0.0)
        if self.state.plan is not None:
            s["plan"] = self.state.plan.to_json()
        if self.cache.field is not None:
            s["parameters"] = self.cache.field.n_parameters()
            s["scale"] = float(self.cache.field.scale[0])
        if math.isfinite(self.state.ns_per_query):
            s["ns_per_query"] = self.state.ns_per_query
        return s

    @locked
    def measure_query(self, n: int = 2**16) -> float:
        """Nanoseconds per cache query, as :meth:`probe` asks it. Also kept for :meth:`statistics`."""
        field = self.cache.queried
        if field is None:
            raise RuntimeError(f"{self.plugin}: there is no cache yet; render an image or call train() first")

        @dr.freeze
        def run(field, seed):
            sampler = PathSampler.make(dr.arange(mi.UInt32, n), seed)
            plain = getattr(field, "field", field)
            x = mi.Vector3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
            return self.probe(field, plain.box_min + x / plain.box_inv_extent, sampler)

        times = []
        with dr.suspend_grad():
            for k in range(7):
                dr.sync_thread()
                t0 = time.perf_counter()
                with undisturbed():
                    dr.eval(run(field, dr.opaque(mi.UInt32, k)))
                dr.sync_thread()
                times.append(time.perf_counter() - t0)
        self.state.ns_per_query = float(np.median(times[2:])) / (n * self.PROBES) * 1e9
        return self.state.ns_per_query

    #: Queries at a point of :meth:`probe`.
    PROBES = 8

    def probe(self, field, x, sampler):
        """What :meth:`measure_query` times: a position encoded once and queried in `PROBES` directions."""
        features = field.encode(x, mi.Normal3f(0, 0, 1))

        def ask(i, total, sampler):
            w = mi.warp.square_to_uniform_sphere(sampler.next_2d())
            return i + 1, total + field.query(features, w), sampler

        _, total, _ = dr.while_loop((mi.UInt32(0), mi.Color3f(0), sampler), lambda i, t, s: i < self.PROBES, ask)
        return total

    # -------------------------------------------------------------------------------------------------------------
    # Cache files

    def file_facts(self) -> dict:
        """What a cache file says about its integrator (JSON values)."""
        return {"plugin": self.plugin}

    def check_file(self, path, header: dict) -> None:
        """Raise `CacheFileError` for a cache, of the right sizes, that means something else here."""

    save_cache, load_cache = cache_files.save_cache, cache_files.load_cache

    # -------------------------------------------------------------------------------------------------------------
    # Rendering

    def incident_radiance(self, scene, lights, field, path, found, after, sampler):
        """Radiance, emission apart, that the ray of a bounce brings from `after` to `path`, by the cache; not
        differentiated: (Li, sampler)."""
        return gradients.by_incident_cache(self, scene, lights, field, path, found, after, sampler)

    render_forward, render_backward = gradients.render_forward, gradients.render_backward

    def rendered(self, spp: int) -> None:
        self._publish()
        self.state.images += 1
        self.state.image_open = self.film_state.planned_spp is not None

    def _render(self, scene, sensor, seed, spp: int):
        block = super()._render(scene, sensor, seed, spp)
        self.state.queries += self.queries_per_sample * Area.of(sensor).n_pixels * spp
        return block
