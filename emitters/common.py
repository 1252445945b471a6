"""What light samplers share: the table of the scene's lights, rebuilt when they change."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_neural import parameters, plan
from mi_neural.lights.table import LightTable
from mi_neural.render.binding import BoundScene
from mi_neural.render.frozen import is_recording
from mi_neural.render.kernels import on_gpu


class LightSampler(mi.Emitter):
    """Base of the light samplers. Subclasses give `make`.

    A light sampler emits nothing: it is nested in an integrator, under the name ``light_sampler``. Before each image
    the integrator calls ``lights(scene, sensor)``, which returns the object that chooses lights in this scene; None
    stands for the scene's own choice.
    """

    def __init__(self, props):
        super().__init__(props)
        self.plugin = props.plugin_name()
        self.scene = BoundScene()
        self.edits: parameters.Edits | None = None  # of the lights' parameters; None where there is nothing to choose
        self.sampler = None
        self.plan_mode = props.get("plan", "scene")
        self._check(self.plan_mode in plan.MODES,
                    f"plan is '{self.plan_mode}'; give one of: {', '.join(plan.MODES)}")  # fmt: skip
        self.plan: plan.ScenePlan | None = None  # of the scene that lights are chosen in

    def _check(self, ok: bool, message: str) -> None:
        if not ok:
            raise ValueError(f"{self.plugin}: {message}")

    def reset(self) -> None:
        """Forget what was learned. The table of lights is kept."""

    def reseed(self, seed: int) -> None:
        """As :meth:`reset`, and learn by the random numbers of another `seed` from now on."""
        self.reset()

    # -------------------------------------------------------------------------------------------------------------
    # To be given by the plugin

    def make(self, scene, table: LightTable):
        """What chooses among the lights of `table`; see :mod:`mi_neural.lights.sampling`."""
        raise NotImplementedError(f"{type(self).__name__} must define make()")

    def given(self) -> dict:
        """Decisions of the plan that keys have fixed, by part."""
        return {}

    def train(self, scene, sensor) -> None:
        """Learn what is learned from image to image."""

    def statistics(self) -> dict:
        """Facts since the last reset."""
        return {}

    # -------------------------------------------------------------------------------------------------------------

    def make_plan(self, facts: plan.SceneFacts) -> plan.ScenePlan:
        """What is built in a scene of these facts, and why."""
        return plan.of_sampler(facts, plan.Request(self.plugin, self.plan_mode, self.given()))

    def lights(self, scene, sensor, train: bool = True):
        """What chooses lights in `scene`; None where there is nothing to choose, at no cost then.

        The table is made anew where the scene is another one, or its lights changed. Raises RuntimeError inside a
        function that the user has frozen: a replay would show lights as they were. ValueError where it would end the
        process.
        """
        if is_recording() and not (self.scene.knows(scene) and self.edits is None):
            raise RuntimeError(
                f"{self.plugin}: inside a function frozen by dr.freeze a light sampler cannot follow the lights; leave "
                "it out there, for example mi.load_dict({'type': 'plain_path'})"
            )
        if not self.scene.knows(scene):
            self.reset()
            self.sampler = None
            self.plan = self.make_plan(plan.SceneFacts.read(scene, sensor))
            self.edits = edits_of(scene) if self.plan.modelled("light_sampler") else None
            self._check(
                not (on_gpu() and self.plan.modelled("environment_cells")),
                "environment_cells ends the process on a GPU (Dr.Jit 1.5.0); set environment_cells=0, or type "
                "mi.set_variant('llvm_ad_rgb')",
            )
            self.scene.changed(scene)  # last: what was refused or interrupted is tried again
        if self.edits is None:
            return None
        with dr.suspend_grad():
            if self.edits.changed():
                self.sampler = self._made(scene)
            if self.sampler is not None and train:
                with dr.resume_grad():
                    self.train(scene, sensor)
        return self.sampler

    def _made(self, scene):
        """What chooses among the lights as they are now; None where there is but one."""
        try:
            table = LightTable(scene, texels=self.plan.modelled("environment_cells"))
            chooses = table.n_lights > 1 or self.plan_mode == "everything" or self.plan.facts.inexact
            return self.make(scene, table) if chooses else None
        except BaseException:  # refused or interrupted: the next image tries again
            self.edits.forget()
            raise

    def to_string(self):
        return f"{type(self).__name__}[plan = {self.plan or self.plan_mode}]"

    # -------------------------------------------------------------------------------------------------------------
    # To Mitsuba it is an emitter, and calls of emitters are compiled for all that are alive: this one emits nothing

    def eval(self, si, active=True):
        return mi.Spectrum(0)

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        return dr.zeros(mi.Ray3f), mi.Spectrum(0)

    def sample_direction(self, it, sample, active=True):
        return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0)

    def pdf_direction(self, it, ds, active=True):
        return mi.Float(0)

    def eval_direction(self, it, ds, active=True):
        return mi.Spectrum(0)

    def sample_position(self, time, sample, active=True):
        return dr.zeros(mi.PositionSample3f), mi.Float(0)

    def pdf_position(self, ps, active=True):
        return mi.Float(0)

    def sample_wavelengths(self, si, sample, active=True):
        return dr.zeros(mi.Wavelength), mi.Spectrum(0)


def edits_of(scene) -> parameters.Edits:
    """Edits of the parameters that the table is made of."""
    pairs = []
    for emitter in scene.emitters():
        shape = emitter.get_shape()
        params = parameters.traverse(shape if shape is not None else emitter)
        pairs += [(params, key) for key in params.keys()
                  if not key.startswith("bsdf.") and not key.endswith("sampling_weight")]  # fmt: skip
    return parameters.Edits(pairs)
