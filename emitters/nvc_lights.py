"""``nvc_lights``: lights by what they give, times their learned visibility."""

import mitsuba as mi

from mi_neural.caches.visibility import LOSSES, VisibilityCache, VisibilityTraining
from mi_neural.emitters.common import LightSampler
from mi_neural.lights import clusters
from mi_neural.lights.sampling import VisibleLights


class NVCLightSampler(LightSampler):
    r"""
    .. _emitter-nvc_lights:

    Choice of lights by learned visibility (:monosp:`nvc_lights`)
    -------------------------------------------------------------

    Chooses light :math:`i` with a probability proportional to what it would give the surface without shadows, times
    the share of it that is visible from there as a small network predicts (neural visibility cache; METHODS 4 and the
    seed's eq. for p(x)):

    .. math:: p_i(x) \propto E_i(x) \max(V_i(x), 0.06).

    :math:`E_i` bounds the irradiance from light *i* by its distance, size and the cosines at both ends (Conty Estevez
    and Kulla 2018). Unbiased whatever the network says, since no light that can contribute has probability 0. With
    more lights than ``outputs`` the network knows clusters of them: a cluster is chosen as above, then one light in it
    by resampling ``candidates`` of its lights.

    .. pluginparameters::

     * - outputs
       - |int|
       - Most outputs of the network; up to that many lights are known one by one. (Default: 32)
     * - clusters
       - |string|
       - What an output stands for where there are more lights: ``kmeans`` (near each other), ``emitter`` (all
         triangles of an emitter), ``auto`` (by emitter if there are few, small ones). (Default: auto)
     * - environment_cells
       - |int|
       - Parts of the environment that the network has an output for each, beside ``outputs``; 0: the environment is one
         light, and Mitsuba chooses a direction in it. 32 of them have a quarter less noise in a room lit through
         windows, and cost as much in time (``mi-neural doc measured``). (Default: 0)
     * - candidates
       - |int|
       - Lights of a cluster that one is resampled from. (Default: 16)
     * - visibility
       - |bool|
       - Use the network. false: choose by unshadowed light alone, nothing is trained. (Default: true)
     * - train_frames
       - |int|
       - Training steps before the first image. (Default: 32)
     * - train_steps
       - |int|
       - Training steps before each later image. (Default: 1)
     * - train_samples
       - |int|
       - Points per step; each sends one shadow ray to every output. (Default: 2048)
     * - loss
       - |string|
       - What training lessens: ``cross_entropy``, or ``squared`` as published, which learns nothing where each light is
         seen from few points (``mi-neural doc measured``). (Default: cross_entropy)
     * - freeze
       - |bool|
       - Do not train; an untrained network says 1/2 for every light. (Default: false)
     * - seed
       - |int|
       - Of the initial weights, the training points and the clusters. (Default: 0)
     * - plan
       - |string|
       - ``scene``: build only what the scene needs. ``everything``: whatever it needs, to compare and to look for
         faults. (Default: scene)

    *Works with* all emitters of Mitsuba; point, spot and directional lights, meshes of thousands of emissive triangles
    and the environment can be mixed. With a single light it costs nothing. Points in a participating
    medium count light from all directions alike, and boundaries of media are no walls. *Leaves out* what media absorb
    on the way, phase functions, and glossy lobes: surfaces weigh lights by irradiance (with the lobes by linearly
    transformed cosines a choice takes 2 to 2.6 times as long; variance 0.98 of this on a staircase, 0.67 between
    glossy lamps).

    .. tabs::
        .. code-tab:: xml

            <integrator type="nirc"> <emitter type="nvc_lights" name="light_sampler"/> </integrator>

        .. code-tab:: python

            mi.load_dict({"type": "nirc", "light_sampler": {"type": "nvc_lights", "outputs": 32}})
    """

    def __init__(self, props):
        self.cache, self.begun = None, False
        self.outputs = props.get("outputs", 32)
        self.clusters = props.get("clusters", "auto")
        self.environment_cells = props.get("environment_cells", 0)
        keys = ("outputs", "clusters", "environment_cells", "visibility")
        self.fixed = {key: props[key] for key in keys if key in props}
        self.candidates = props.get("candidates", 16)
        self.visibility = props.get("visibility", True)
        self.train_frames = props.get("train_frames", 32)
        self.train_steps = props.get("train_steps", 1)
        self.train_samples = props.get("train_samples", 2048)
        self.loss = props.get("loss", "cross_entropy")
        self.freeze = props.get("freeze", False)
        self.seed = props.get("seed", 0)
        super().__init__(props)
        self._check(2 <= self.outputs <= 256, f"outputs is {self.outputs}; it must lie in 2..256")
        self._check(self.clusters in clusters.METHODS,
                    f"clusters is '{self.clusters}'; give one of: {', '.join(clusters.METHODS)}")  # fmt: skip
        self._check(0 <= self.environment_cells <= 256,
                    f"environment_cells is {self.environment_cells}; it must lie in 0..256")  # fmt: skip
        self._check(self.candidates >= 1, f"candidates is {self.candidates}; it must be at least 1")
        self._check(self.train_frames >= 0, f"train_frames is {self.train_frames}; it must be 0 or more")
        self._check(self.train_steps >= 0, f"train_steps is {self.train_steps}; it must be 0 or more")
        self._check(self.train_samples >= 4, f"train_samples is {self.train_samples}; it must be at least 4")
        self._check(self.loss in LOSSES, f"loss is '{self.loss}'; give one of: {', '.join(LOSSES)}")
        self._check(self.seed >= 0, f"seed is {self.seed}; it must be 0 or more")
        training = VisibilityTraining(n_points=self.train_samples, loss=self.loss)
        self.cache = VisibilityCache(training, seed=self.seed)

    def reset(self) -> None:
        self.begun = False
        if self.cache is not None:
            self.cache.reset()
        if self.sampler is not None:
            self.sampler.field = None

    def reseed(self, seed: int) -> None:
        self.cache.seed = seed
        self.reset()

    def make(self, scene, table):
        try:
            cells = int(self.plan["environment_cells"])
            groups = clusters.make_groups(table, self.outputs, self.clusters, self.seed, cells)
        except ValueError as e:
            raise ValueError(f"{self.plugin}: {e}") from None
        field = self.cache.field if self.visibility else None
        if field is not None and field.shape.n_outputs != groups.n_groups:
            self.cache.reset()  # lights appeared or went
            self.begun = False
            field = None
        return VisibleLights(table, groups, field, self.candidates)

    def given(self) -> dict:
        return self.fixed

    def train(self, scene, sensor) -> None:
        if not self.visibility:
            return
        steps = 0 if self.freeze else self.train_steps if self.begun else self.train_frames
        self.begun = True
        self.cache.train(scene, sensor, self.sampler.table, self.sampler.groups, frames=steps)
        self.sampler.field = self.cache.field

    def statistics(self) -> dict:
        if self.sampler is None:
            return {}
        facts = {"lights": self.sampler.table.n_lights, "light_groups": self.sampler.groups.n_groups}
        return facts | (self.cache.statistics if self.visibility else {})

    def to_string(self):
        return (
            f"NVCLightSampler[\n  outputs = {self.outputs},\n  clusters = {self.clusters},\n"
            f"  candidates = {self.candidates},\n  plan = {self.plan or self.plan_mode}\n]"
        )


mi.register_emitter("nvc_lights", lambda props: NVCLightSampler(props))
