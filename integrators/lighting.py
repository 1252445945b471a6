"""What integrators share that choose lights by a nested light sampler."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_neural.integrators.base import FilmIntegrator, Nonfinite
from mi_neural.integrators.checks import check_scene
from mi_neural.integrators.gradients import moved, name_black_lamps
from mi_neural.integrators.planning import exact_sampler
from mi_neural.render.binding import BoundScene
from mi_neural.render.film import recordable, sensor_of
from mi_neural.render.frozen import LOCK, locked


def light_sampler_of(props):
    """The nested light sampler of a plugin's properties, None without one. Raises ValueError for anything else, and for
    one that has another name: Mitsuba would call it an unreferenced property."""
    for key, value in props.props.objects(False):  # first: it marks all as not asked for
        if key != "light_sampler" and hasattr(value, "lights"):
            name = "" if key.startswith("_arg_") else f", not {key!r}"
            raise ValueError(
                f"{props.plugin_name()}: the name of a nested light sampler is light_sampler{name}; type "
                f'<emitter type="{value.plugin}" name="light_sampler"/>'
            )
    given = props.get("light_sampler", None)
    if given is not None and not hasattr(given, "lights"):
        raise ValueError(
            f"{props.plugin_name()}: light_sampler is not a light sampler; nest one, for example "
            '<emitter type="nvc_lights" name="light_sampler"/>'
        )
    return given


class LightSamplingIntegrator(FilmIntegrator):
    """Base of the integrators that learn nothing but what their light sampler learns. Subclasses give `estimate`.

    `lights` is what chooses lights in the image being rendered; None: the scene itself.
    """

    #: Whether images may be rendered with gradients.
    differentiable = True
    PASS_SAMPLES, PIXEL_BYTES = 2**22, 64

    def __init__(self, props):
        super().__init__(props)
        self.light_sampler = self.nested_sampler = light_sampler_of(props)
        self.lights = None
        self.bound = BoundScene()

    @property
    def bound_lights(self):
        return self.lights

    def bind(self, scene, sensor, train: bool = True) -> None:
        """Have lights chosen as they are in `scene` now; one frame of training. Refuses what cannot be rendered."""
        if not self.bound.knows(scene):
            check_scene(scene, self.plugin, self.renders_media)
            self.film_state.forget_scene()
            self.light_sampler = self.nested_sampler or exact_sampler(scene)
            self.lights = None
            self.bound.changed(scene)
        self.film_state.n_bound += 1
        if self.light_sampler is not None:
            view = recordable(sensor, self.film_state.n_bound, self.film_state.scene_records(scene))
            self.lights = self.light_sampler.lights(scene, view, train)

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        if self.film_state.entered:  # Mitsuba's own render() comes back here once
            return mi.SamplingIntegrator.render(self, scene, sensor, seed, spp, develop, evaluate)
        if not (self.differentiable and differentiates()):
            return super().render(scene, sensor, seed, spp, develop, evaluate)
        sensor = self._checked(scene, sensor, spp)
        with LOCK:
            self.bind(scene, sensor)
            self.check_gradients(scene)
            self.film_state.entered = True
            try:
                image = mi.SamplingIntegrator.render(self, scene, sensor, seed, spp, develop, evaluate)
            finally:
                self.film_state.entered = False
            if self.should_stop():  # Ctrl-C, which Mitsuba takes in its own render() and may keep to itself
                raise KeyboardInterrupt
            return image

    def check_gradients(self, scene) -> None:
        """Refuse what cannot be rendered with gradients in the scene that is bound; what is left out is said once."""
        if self.lights is None:
            return
        moving = moved(scene, mi.traverse(scene), lamps=True)
        if moving:
            self.lights = None
            self.film_state.say_once(
                f"{self.plugin}: lights are chosen as Mitsuba does, without {self.light_sampler.plugin}, where "
                f"gradients of their shapes are wanted: {', '.join(moving[:4])}{', ...' if len(moving) > 4 else ''}"
            )
        else:
            name_black_lamps(self)

    def reset(self) -> None:
        """Forget what was learned. Compiled kernels are kept."""
        self.lights = None
        self.film_state.nonfinite = Nonfinite()
        if self.light_sampler is not None:
            self.light_sampler.reset()

    def reseed(self, seed: int) -> None:
        """As :meth:`reset`, and learn by the random numbers of another `seed` from now on."""
        if self.light_sampler is not None:
            self.light_sampler.reseed(seed)
        self.reset()

    @locked
    def train(self, scene, frames: int, sensor=0, progress=None) -> dict:
        """Train the light sampler for so many frames. `progress` is called with (done, total). Returns `statistics`."""
        sensor = sensor_of(scene, sensor, self.plugin)
        for k in range(frames if self.light_sampler is not None else 0):
            self.bind(scene, sensor)
            if progress is not None:
                progress(k + 1, frames)
        return self.statistics()

    @locked
    def prepare(self, scene, sensor=0, spp: int = 1) -> None:
        """Compile all that a render call with `spp` needs. A cache without training records is left unchanged."""
        sensor = sensor_of(scene, sensor, self.plugin)
        fresh = self.untrained
        try:
            with dr.suspend_grad():
                for _ in range(3):  # the first recordings of a frozen function differ from what it then replays
                    dr.eval(self.render(scene, sensor, 0, spp))
            dr.sync_thread()
        finally:
            if fresh:
                self.reset()

    @property
    def untrained(self) -> bool:
        """Whether nothing has been learned."""
        return not self.statistics().get("visibility_steps")

    def statistics(self) -> dict:
        """Facts since the last reset: what the light sampler says of itself."""
        facts = self.light_sampler.statistics() if self.light_sampler is not None else {}
        return {"seconds_train": facts.get("seconds_visibility", 0.0), **self.film_state.statistics(), **facts}


def differentiates() -> bool:
    """Whether gradients are being tracked."""
    x = mi.Float(0)
    dr.enable_grad(x)
    return dr.grad_enabled(x)
