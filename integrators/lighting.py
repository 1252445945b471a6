"""What integrators share that choose lights by a nested light sampler."""

from __future__ import annotations

import weakref

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.integrators.checks import check_film, check_scene, sensor_of
from mi_neural.render.binding import SceneWatch
from mi_neural.render.frozen import can_freeze, undisturbed

#: Most camera samples traced at once: what Ctrl-C has to wait for, some seconds.
PASS_SAMPLES = 2**22
#: What a camera sample takes in memory, the film's copies with it (measured on two cores: 22 to 29 bytes).
SAMPLE_BYTES = 64

LIGHT_SAMPLER_KEY = """
     * - light_sampler
       - |emitter|
       - Nested plugin that chooses the light of each shadow ray: ``uniform_lights``, ``power_lights``, ``nvc_lights``.
         (Default: the scene's own choice, as in ``path``)
"""


def light_sampler_of(props):
    """The nested light sampler of a plugin's properties, None without one. Raises ValueError for anything else."""
    given = props.get("light_sampler", None)
    if given is not None and not hasattr(given, "lights"):
        raise ValueError(
            f"{props.plugin_name()}: light_sampler is not a light sampler; nest one, for example "
            '<emitter type="nvc_lights" name="light_sampler"/>'
        )
    return given


class _Images:
    """Frozen functions that render images of one scene."""

    def __init__(self):
        self.scene, self.frozen, self.sensors = SceneWatch(), {}, {}
        self.stopped = False  # by a Ctrl-C that Mitsuba's own render() took


class LightSamplingIntegrator(mi.SamplingIntegrator):
    """Base of the integrators that learn nothing but what their light sampler learns. Subclasses give `sample`.

    `lights` is what chooses lights in the image being rendered; None: the scene itself. Images without gradients are
    rendered by a frozen function, which is traced once and not for each image: in a scene of a thousand shapes that
    takes longer than a sample a pixel.
    """

    #: Whether images may be rendered by frozen functions, and with gradients.
    freezes = differentiable = True

    def __init__(self, props):
        super().__init__(props)
        self.plugin = props.plugin_name()
        self.light_sampler = light_sampler_of(props)
        self.lights, self.entered = None, False
        self.images = _Images()
        self.met = SceneWatch()

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        sensor = sensor_of(scene, sensor, self.plugin)
        if self.entered:  # Mitsuba's own render() comes back here once
            return super().render(scene, sensor, seed, spp, develop, evaluate)
        if spp < 0:
            raise ValueError(f"{self.plugin}: spp is {spp}; give 0 (the sampler's own count) or more")
        check_film(sensor, self.plugin, SAMPLE_BYTES)
        self.entered = True
        try:
            if self.differentiable and _differentiates():
                self.prepare_lights(scene, sensor)
                image = super().render(scene, sensor, seed, spp, develop, evaluate)
                if self.should_stop():  # Ctrl-C, which Mitsuba takes in its own render() and may keep to itself
                    raise KeyboardInterrupt
                return image
            with dr.suspend_grad():
                self.prepare_lights(scene, sensor)
                return self._render(scene, sensor, seed, spp or sensor.sampler().sample_count(), develop, evaluate)
        finally:
            self.entered = False

    def _render(self, scene, sensor, seed, spp: int, develop: bool, evaluate: bool):
        """An image without gradients, in passes that fit memory."""
        film, sampler = sensor.film(), sensor.sampler()
        first = int(mi.UInt32(seed)[0])
        size, total = max(1, PASS_SAMPLES // (int(film.crop_size()[0]) * int(film.crop_size()[1]))), None
        for k, done in enumerate(range(0, spp, size)):
            n = min(size, spp - done)
            image = self._image(scene, sensor, n)
            sampler.set_sample_count(n)
            # Their state is an argument as well
            film.prepare(self.aov_names())
            sampler.seed(0, 1)
            number = first if k == 0 else int(np.random.SeedSequence((first, k)).generate_state(1)[0])
            with undisturbed():
                raw = image(scene, sensor, self.lights, dr.opaque(mi.UInt32, number))
            if self.images.stopped:
                self.images.stopped = False
                raise KeyboardInterrupt
            total = raw if total is None else total + raw
            dr.eval(total)
        sampler.set_sample_count(spp)
        film.prepare(self.aov_names())
        film.put_block(mi.ImageBlock(total, film.crop_offset(), film.rfilter()))
        sampler.seed(0, 1)
        result = film.develop() if develop else mi.TensorXf()
        if evaluate:
            dr.eval(result)
        return result

    def _image(self, scene, sensor, spp: int):
        """A function that renders `spp` samples a pixel and gives the film's raw content; frozen, if `sensor` lets it
        be."""
        if self.images.scene.changed(scene):
            self.images.frozen.clear()
            self.images.sensors.clear()
        if id(sensor) not in self.images.sensors:
            self.images.sensors[id(sensor)] = sensor, can_freeze(sensor)  # held, so that no other has its id
        # Held weakly: an attribute that changes would have it recorded anew
        image = _image_of(weakref.ref(self), spp)
        if not (self.freezes and self.images.sensors[id(sensor)][1]):
            return image
        film = sensor.film()
        keys = tuple((k, v) for k, v in vars(self).items() if isinstance(v, (int, float, str)))
        key = (id(sensor), *film.crop_size(), *film.crop_offset(), spp, keys)
        if key not in self.images.frozen:
            self.images.frozen[key] = dr.freeze(image, auto_opaque=False)
        return self.images.frozen[key]

    def ready(self, scene) -> None:
        """Have lights chosen also where another integrator (``aov``) asks for samples and no image is rendered."""
        if not self.entered:
            self.prepare_lights(scene, scene.sensors()[0])

    def prepare_lights(self, scene, sensor, train: bool = True) -> None:
        """Have lights chosen as they are in `scene` now; one frame of training. Refuses what cannot be rendered."""
        if not self.met.knows(scene):
            check_scene(scene, self.plugin)
            self.met.changed(scene)
        if self.light_sampler is not None:
            self.lights = self.light_sampler.lights(scene, sensor, train)

    def reset(self) -> None:
        """Forget what was learned. Compiled kernels are kept."""
        self.lights = None
        if self.light_sampler is not None:
            self.light_sampler.reset()

    def reseed(self, seed: int) -> None:
        """As :meth:`reset`, and learn by the random numbers of another `seed` from now on."""
        if self.light_sampler is not None:
            self.light_sampler.reseed(seed)
        self.reset()

    def train(self, scene, frames: int, sensor=0, progress=None) -> dict:
        """Train the light sampler for so many frames. `progress` is called with (done, total). Returns `statistics`."""
        sensor = sensor_of(scene, sensor, self.plugin)
        for k in range(frames if self.light_sampler is not None else 0):
            self.prepare_lights(scene, sensor)
            if progress is not None:
                progress(k + 1, frames)
        return self.statistics()

    def prepare(self, scene, sensor=0, spp: int = 1) -> None:
        """Compile all that a render call with `spp` needs. Who has learned nothing yet has not afterwards."""
        sensor = sensor_of(scene, sensor, self.plugin)
        fresh = not self.statistics().get("visibility_steps")
        with dr.suspend_grad():
            for _ in range(3):  # the first recordings of a frozen function differ from what it then replays
                dr.eval(self.render(scene, sensor, 0, spp))
        dr.sync_thread()
        if fresh:
            self.reset()

    def statistics(self) -> dict:
        """Facts since the last reset: what the light sampler says of itself."""
        facts = self.light_sampler.statistics() if self.light_sampler is not None else {}
        return {"seconds_train": facts.get("seconds_visibility", 0.0), **facts}


def _differentiates() -> bool:
    """Whether gradients are being tracked."""
    x = mi.Float(0)
    dr.enable_grad(x)
    return dr.grad_enabled(x)


def _image_of(integrator, spp: int):
    """A function that renders an image by `integrator`, a weak reference, to be frozen."""

    def image(scene, sensor, lights, seed):
        it = integrator()
        known, it.lights = it.lights, lights
        try:
            mi.SamplingIntegrator.render(it, scene, sensor, seed, spp, False, False)
            it.images.stopped |= it.should_stop()
        finally:
            it.lights = known
        raw = sensor.film().develop(raw=True)
        sensor.sampler().seed(0, 1)  # or its state would be computed, by half of the work anew
        dr.eval(raw)
        return raw

    return image
