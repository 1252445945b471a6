"""What integrators share that choose lights by a nested light sampler."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_neural.integrators.checks import sensor_of

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


class LightSamplingIntegrator(mi.SamplingIntegrator):
    """Base of the integrators that learn nothing but what their light sampler learns. Subclasses give `sample`.

    `lights` is what chooses lights in the image being rendered; None: the scene itself.
    """

    def __init__(self, props):
        super().__init__(props)
        self.plugin = props.plugin_name()
        self.light_sampler = light_sampler_of(props)
        self.lights, self.entered = None, False

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        sensor = sensor_of(scene, sensor, self.plugin)
        if self.entered:  # Mitsuba's own render() comes back here once
            return super().render(scene, sensor, seed, spp, develop, evaluate)
        self.entered = True
        try:
            self.prepare_lights(scene, sensor)
            return super().render(scene, sensor, seed, spp, develop, evaluate)
        finally:
            self.entered = False

    def ready(self, scene) -> None:
        """Have lights chosen also where another integrator (``aov``) asks for samples and no image is rendered."""
        if not self.entered:
            self.prepare_lights(scene, scene.sensors()[0])

    def prepare_lights(self, scene, sensor, train: bool = True) -> None:
        """Have lights chosen as they are in `scene` now; one frame of training."""
        if self.light_sampler is not None:
            self.lights = self.light_sampler.lights(scene, sensor, train)

    def reset(self) -> None:
        """Forget what was learned. Compiled kernels are kept."""
        self.lights = None
        if self.light_sampler is not None:
            self.light_sampler.reset()

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
        for _ in range(3):  # the first recordings of a frozen function differ from what it then replays
            dr.eval(self.render(scene, sensor, 0, spp))
        dr.sync_thread()
        if fresh:
            self.reset()

    def statistics(self) -> dict:
        """Facts since the last reset: what the light sampler says of itself."""
        facts = self.light_sampler.statistics() if self.light_sampler is not None else {}
        return {"seconds_train": facts.get("seconds_visibility", 0.0), **facts}
