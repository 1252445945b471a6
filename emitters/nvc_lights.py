"""``nvc_lights``: lights by what they give, times their learned visibility."""

from dataclasses import asdict, dataclass, replace

import drjit as dr
import mitsuba as mi

from mi_neural.caches import presets
from mi_neural.caches.visibility import GRID, LOSSES, VisibilityCache, VisibilityTraining
from mi_neural.emitters.common import LightSampler
from mi_neural.lights import clusters
from mi_neural.lights.cells import CellLights
from mi_neural.lights.sampling import VISIBILITY_FLOOR, VisibleLights


@dataclass(frozen=True)
class Constants:
    """What a preset decides; see the keys of the same names. `clustered`: what differs where lights are clustered."""

    train_frames: int = 32
    train_samples: int = VisibilityTraining.n_points
    world_points: float = VisibilityTraining.world_points
    vertices: int = VisibilityTraining.vertices
    loss: str = VisibilityTraining.loss
    first_rate: float = VisibilityTraining.first_rate
    last_rate: float = VisibilityTraining.last_rate
    rate_steps: int = VisibilityTraining.ramp
    averaging: float = VisibilityTraining.ema_decay
    levels: int = GRID["n_levels"]
    base_resolution: int = GRID["base_resolution"]
    level_scale: float = GRID["per_level_scale"]
    init: str = "uniform"
    floor: float = VISIBILITY_FLOOR
    cluster_choice: str = "received"
    within: str = "power"

    def clustered(self) -> "Constants":
        return self


@dataclass(frozen=True)
class Paper(Constants):
    """As printed; see :class:`~mi_neural.caches.presets.NeuralVisibility`."""

    def clustered(self) -> Constants:
        return replace(self, **asdict(presets.ClusteredVisibility()))


#: How lights are chosen in media.
IN_MEDIA = ("cells", "network")
PRESETS = {"measured": Constants(), "paper": Paper(**asdict(presets.NeuralVisibility()))}


class NVCLightSampler(LightSampler):
    r"""
    .. _emitter-nvc_lights:

    Choice of lights by learned visibility (:monosp:`nvc_lights`)
    -------------------------------------------------------------

    Chooses light :math:`i` with a probability proportional to its unshadowed light on the surface, times the share of
    it that is visible from there, which a small network predicts (neural visibility cache; Bokšanský and Meister 2025,
    section 3):

    .. math:: p_i(x) \propto E_i(x) \max(V_i(x), f),

    where :math:`f` is the key ``floor``. :math:`E_i` bounds the irradiance from light *i* by its distance, size and the
    cosines at both ends (Conty Estevez and Kulla 2018). The choice is unbiased whatever the network predicts, since no
    light that can contribute has probability 0. With more lights than ``outputs`` the network has outputs for clusters
    of them: a cluster is chosen as above, then one light in it by resampling ``candidates`` of its lights.

    .. pluginparameters::

     * - preset
       - |string|
       - ``measured``: the defaults below. ``paper``: the constants as printed. A key that you set overrides the preset.
         The list below has both. (Default: measured)
     * - outputs
       - |int|
       - Largest number of outputs of the network; so many lights have an output each. (Default: 32)
     * - clusters
       - |string|
       - What an output is for where there are more lights than outputs: ``kmeans`` (near each other), ``emitter`` (all
         triangles of an emitter), ``auto`` (by emitter if there are few, small ones). (Default: auto)
     * - environment_cells
       - |int|
       - Number of parts of the environment with an output each, beside ``outputs``; 0: the environment is one light,
         and Mitsuba chooses a direction in it. 32 of them have a quarter less noise in a room lit through
         windows, and cost as much in time (``mi-neural doc measured``). (Default: 0)
     * - candidates
       - |int|
       - Number of lights of a cluster from which one is resampled. (Default: 16)
     * - in_media
       - |string|
       - How lights are chosen in scenes with participating media, where each has an output of its own. ``cells``: by a
         table of the weights above in cells of the scene, made anew after 16 training steps. ``network``: by the
         weights at the point itself, which takes longer. (Default: cells)
     * - visibility
       - |bool|
       - Use the network. false: choose by unshadowed light alone; nothing is trained. (Default: true)
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
       - The loss of training: ``cross_entropy``, or ``squared`` as published, which learns nothing where each light is
         seen from few points (``mi-neural doc measured``). (Default: cross_entropy)
     * - world_points
       - |float|
       - Share of these points that lie anywhere in the box of what is seen; the others lie on surfaces. (Default: 0.25)
     * - vertices
       - |int|
       - The other points lie on surfaces at the first so many vertices of camera paths. (Default: 3)
     * - first_rate, last_rate
       - |float|
       - Learning rates of Adam at a place that is new, and at one that has been trained ``rate_steps`` times.
         (Default: 0.05, 0.001)
     * - rate_steps
       - |int|
       - Steps in which the rate falls, linearly. (Default: 200)
     * - averaging
       - |float|
       - Share of the old weights in each step of the average that is used; 0: the latest weights. (Default: 0.9)
     * - levels
       - |int|
       - Levels of the hash grid. (Default: 6)
     * - base_resolution
       - |int|
       - Cells of the coarsest level along an axis. (Default: 8)
     * - level_scale
       - |float|
       - Factor of that number from level to level. (Default: 1.7)
     * - init
       - |string|
       - Initial weights of the network: ``uniform`` (Dr.Jit's), or ``he``. (Default: uniform)
     * - floor
       - |float|
       - Smallest visibility that counts; smaller predictions are raised to it. (Default: 0.06)
     * - cluster_choice
       - |string|
       - Weight of a cluster of several lights: ``received``, what it would give times its visibility, or
         ``visibility`` alone. (Default: received)
     * - within
       - |string|
       - Candidates in a cluster: by ``power``, or ``uniform``. (Default: power)
     * - freeze
       - |bool|
       - Do not train; an untrained network predicts 1/2 for every light. (Default: false)
     * - seed
       - |int|
       - Of the initial weights, the training points and the clusters. (Default: 0)
     * - plan
       - |string|
       - ``scene``: build only what the scene needs. ``everything``: build all parts, to compare and to look for
         faults. (Default: scene)

    The presets: the published value (Bokšanský and Meister 2025, sections 3.2 to 3.4 and figure 5; values behind a
    semicolon hold where lights are clustered) / the default / why it differs.

    - ``train_frames``: 1 / 32 / the first image has a trained network.
    - ``train_samples``, ``world_points``, ``vertices``: 8192, 0.5, 1; 49152 / 2048, 0.25, 3 / so spread, 2048 points a
      step do as well as 8192.
    - ``loss``: squared / cross_entropy / where a lamp is seen by 2 or 3 % of the points, with the squared error all
      predictions are 0 from the fifth step on.
    - ``first_rate``, ``last_rate``, ``rate_steps``: 0.05, 0.001, 200 / the same; in both presets the rate falls with
      the age of a place, not with that of the network.
    - ``averaging``: none / 0.9 / not measured.
    - ``levels``, ``base_resolution``, ``level_scale``: 10, 16, not published (2 is used); 8, 2 / 6, 8, 1.7 / Sponza
      with 32 lamps: variance 0.453 in 148 ms, with 10 levels from 16 on 0.514 in 160 ms.
    - ``init``: he / uniform / not measured.
    - ``floor``: 0.001 / 0.06 / Sponza with 32 lamps: relMSE 0.13 (trimmed 0.10), with 0.001 2.1 (0.09).
    - ``cluster_choice``, ``within``: visibility, uniform / received, power / not measured.
    - Weight of a light: by linearly transformed cosines / a bound on its irradiance, in both presets / the former takes
      2 to 2.6 times as long for a variance of 0.98 (Sponza) or 0.67 (glossy lamps); there is no key for it.

    The measurements are those of ``mi-neural doc measured``. Four features a level, 2^14 entries, two hidden layers of
    32 leaky rectifiers (0.01) and the sigmoid are the paper's in both presets.

    *Works with* all emitters of Mitsuba; point, spot and directional lights, meshes of thousands of emissive triangles
    and the environment can be mixed. With a single light nothing is built. Points in a participating
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
        self.cache, self.begun, self.cells = None, False, None
        self.outputs = props.get("outputs", 32)
        self.clusters = props.get("clusters", "auto")
        self.environment_cells = props.get("environment_cells", 0)
        keys = ("outputs", "clusters", "environment_cells", "visibility")
        self.fixed = {key: props[key] for key in keys if key in props}
        self.candidates = props.get("candidates", 16)
        self.in_media = props.get("in_media", "cells")
        self.visibility = props.get("visibility", True)
        self.train_steps = props.get("train_steps", 1)
        self.freeze = props.get("freeze", False)
        self.seed = props.get("seed", 0)
        super().__init__(props)
        self._read_constants(props)
        self._check(2 <= self.outputs <= 256, f"outputs is {self.outputs}; it must lie in 2..256")
        self._check(self.clusters in clusters.METHODS,
                    f"clusters is '{self.clusters}'; give one of: {', '.join(clusters.METHODS)}")  # fmt: skip
        self._check(0 <= self.environment_cells <= 256,
                    f"environment_cells is {self.environment_cells}; it must lie in 0..256")  # fmt: skip
        self._check(self.candidates >= 1, f"candidates is {self.candidates}; it must be at least 1")
        self._check(self.in_media in IN_MEDIA,
                    f"in_media is '{self.in_media}'; give one of: {', '.join(IN_MEDIA)}")  # fmt: skip
        self._check(self.train_frames >= 0, f"train_frames is {self.train_frames}; it must be 0 or more")
        self._check(self.train_steps >= 0, f"train_steps is {self.train_steps}; it must be 0 or more")
        self._check(self.seed >= 0, f"seed is {self.seed}; it must be 0 or more")
        self.constants, self.cache = self.alone, self._make_cache(self.alone)

    def _read_constants(self, props) -> None:
        """Those for single lights (`alone`) and for clusters: of the preset, but for keys that are given."""
        self.preset = props.get("preset", "measured")
        self._check(self.preset in PRESETS, f"preset is '{self.preset}'; give one of: {', '.join(PRESETS)}")
        preset = PRESETS[self.preset]
        given = {
            "train_frames": props.get("train_frames", None), "train_samples": props.get("train_samples", None),
            "world_points": props.get("world_points", None), "vertices": props.get("vertices", None),
            "loss": props.get("loss", None), "averaging": props.get("averaging", None),
            "first_rate": props.get("first_rate", None), "last_rate": props.get("last_rate", None),
            "rate_steps": props.get("rate_steps", None),
            "levels": props.get("levels", None), "base_resolution": props.get("base_resolution", None),
            "level_scale": props.get("level_scale", None), "init": props.get("init", None),
            "floor": props.get("floor", None), "cluster_choice": props.get("cluster_choice", None),
            "within": props.get("within", None),
        }  # fmt: skip
        given = {key: value for key, value in given.items() if value is not None}
        self.alone, self.of_clusters = replace(preset, **given), replace(preset.clustered(), **given)
        c = self.alone
        self.train_frames = c.train_frames
        ranges = {"train_samples": (4, 2**20), "world_points": (0, 1), "vertices": (1, 64), "rate_steps": (1, 2**30),
                  "averaging": (0, 1), "levels": (1, 32), "base_resolution": (1, 4096), "floor": (1e-6, 1)}  # fmt: skip
        for key, (low, high) in ranges.items():
            value = getattr(c, key)
            self._check(low <= value <= high, f"{key} is {value}; it must lie in {low}..{high}")
        for key in ("first_rate", "last_rate"):
            self._check(getattr(c, key) > 0, f"{key} is {getattr(c, key)}; it must be greater than 0")
        self._check(1 < c.level_scale <= 16, f"level_scale is {c.level_scale}; it must be above 1 and at most 16")
        choices = {"loss": LOSSES, "init": ("uniform", "he"), "cluster_choice": ("received", "visibility"),
                   "within": ("power", "uniform")}  # fmt: skip
        for key, names in choices.items():
            value = getattr(c, key)
            self._check(value in names, f"{key} is '{value}'; give one of: {', '.join(names)}")

    def _make_cache(self, c: Constants) -> VisibilityCache:
        training = VisibilityTraining(
            n_points=c.train_samples, ema_decay=c.averaging, first_rate=c.first_rate, last_rate=c.last_rate,
            ramp=c.rate_steps, world_points=c.world_points, vertices=c.vertices, loss=c.loss,
        )  # fmt: skip
        grid = {"n_levels": c.levels, "base_resolution": c.base_resolution, "per_level_scale": c.level_scale}
        return VisibilityCache(training, seed=self.seed, grid=grid, he=c.init == "he")

    def reset(self) -> None:
        self.begun, self.cells = False, None
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
            equal = self.alone.within == "uniform"
            groups = clusters.make_groups(table, self.outputs, self.clusters, self.seed, cells, equal)
        except ValueError as e:
            raise ValueError(f"{self.plugin}: {e}") from None
        constants = self.alone if groups.single else self.of_clusters
        if constants != self.constants:
            self.constants, self.begun, seed = constants, False, self.cache.seed
            self.cache = self._make_cache(constants)
            self.cache.seed = seed
        field = self.cache.field if self.visibility else None
        if field is not None and field.shape.n_outputs != groups.n_groups:
            self.cache.reset()  # lights appeared or went
            self.begun = False
            field = None
        self.cells = None
        alone = constants.cluster_choice == "visibility"
        return VisibleLights(table, groups, field, self.candidates, constants.floor, alone)

    def given(self) -> dict:
        return self.fixed

    def train(self, scene, sensor) -> None:
        if not self.visibility:
            return
        steps = 0 if self.freeze else self.train_steps if self.begun else self.train_frames
        self.begun = True
        self.cache.train(scene, sensor, self.sampler.table, self.sampler.groups, frames=steps)
        self.sampler.field = self.cache.field
        if self.in_media == "cells" and self.plan.facts.media and self.sampler.groups.single:
            if self.cells is None:
                self.cells = CellLights(self.sampler, self.cache.field.box)
            with dr.suspend_grad():
                self.cells.follow(self.sampler, self.cache.steps, self.cache.random_seed(self.cache.steps))

    def lights(self, scene, sensor, train: bool = True):
        lights = super().lights(scene, sensor, train)
        return lights if lights is None or self.cells is None else self.cells

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
