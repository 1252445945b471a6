"""Rows of the keys that all integrators with caches have, for their docstrings."""

from dataclasses import asdict

import mitsuba as mi

from mi_neural.caches.presets import PRESETS

LIGHT_SAMPLER_KEY = """
     * - light_sampler
       - |emitter|
       - Nested plugin that chooses the light of each shadow ray: ``uniform_lights``, ``power_lights``, ``tree_lights``,
         ``nvc_lights``. (Default: the scene's own choice, as in ``path``)
"""


#: Keys of whole numbers, and of others, that have no default of their own.
WHOLE = ("levels", "hashmap_size", "width", "hidden_layers", "cache_samples", "residual_samples", "train_records")
NUMBERS = ("residual_probability", "roulette", "guide")


class Keys:
    """A plugin's properties, which refuse a value of another kind than that of the key's default."""

    def __init__(self, props):
        self.props, self.preset = props, {}

    def use_preset(self, name: str, *sources) -> None:
        """Take the constants of `sources`, data classes of :mod:`mi_neural.caches.presets`, in the place of defaults
        from now on, if the preset is ``paper``."""
        if name not in PRESETS:
            raise ValueError(f"{self.plugin_name()}: preset is '{name}'; give one of: {', '.join(PRESETS)}")
        for source in sources if name == "paper" else ():
            self.preset |= asdict(source)

    def get(self, name: str, default):
        value = self.props.get(name, self.preset.get(name, default))
        if default is None and value is not None:
            default = 0 if name in WHOLE else 0.0 if name in NUMBERS else None
        if isinstance(default, bool):
            self._check(isinstance(value, bool), name, value, "true or false")
        elif isinstance(default, int):
            number = isinstance(value, int | float) and not isinstance(value, bool)
            self._check(number and float(value).is_integer(), name, value, "a whole number")
            value = int(value)
        elif isinstance(default, float):
            self._check(isinstance(value, int | float) and not isinstance(value, bool), name, value, "a number")
            value = float(value)
        elif isinstance(default, str):
            self._check(isinstance(value, str), name, value, "a text")
        return value

    def _check(self, ok: bool, name: str, value, kind: str) -> None:
        if not ok:
            raise ValueError(f"{self.props.plugin_name()}: {name} is {value!r}; give {kind}")

    def refuse(self, names: tuple[str, ...], where: str) -> None:
        """Raise ValueError for a key that this plugin does not have and others do; `where`: which."""
        for name in names:
            if name in self:
                raise ValueError(f"{self.plugin_name()}: it has no key '{name}'; {where}")

    def __contains__(self, name: str) -> bool:
        return name in self.props

    def __getitem__(self, name: str):
        return self.props[name]

    def plugin_name(self) -> str:
        return self.props.plugin_name()


def register(name: str, cls) -> None:
    """Make an integrator known to Mitsuba; `cls` may be a function that makes it of :class:`Keys`."""
    mi.register_integrator(name, lambda props: cls(Keys(props)))


#: Keys of ``nirc`` that had no meaning with ``termination="auto"``, and the names of its channels in ``neural_path``.
WITHOUT_MEANING = ("termination", "light_samples", "gather_half", "cache", "cache_samples")
CHANNELS_OF_NIRC = {"direct": "traced", "cache": "cached"}


def older_name(keys: Keys):
    """The ``neural_path`` that ``nirc`` and ``nrc`` with ``termination="auto"`` stand for; None for others."""
    name = keys.plugin_name()
    if name == "nrc" and keys.get("termination", "spread") not in ("spread", "auto"):
        raise ValueError(f"nrc: termination is '{keys['termination']}'; leave it out, paths end by spread_threshold")
    if "termination" not in keys or keys["termination"] != "auto":
        return None
    if "preset" in keys:
        raise ValueError(f"{name}: termination 'auto' is neural_path, which has no preset; leave one of the two out")
    mi.Log(mi.LogLevel.Warn, f"mi_neural: {name} with termination='auto' is now a plugin; type: neural_path")
    dropped = WITHOUT_MEANING + (BLEND_NAMES if keys.get("blend", "ema") == "ema" else ())
    wanted = {key: keys[key] for key in keys.props.keys() if key not in dropped}
    for key in dropped:
        keys.get(key, None)
    if name == "nirc":
        if (kind := keys.get("cache", "plan")) not in ("plan", "network"):
            raise ValueError(f"nirc: termination 'auto' needs cache 'network', not '{kind}'")
        if "channels" in wanted:
            names = [n.strip() for n in wanted["channels"].split(",")]
            wanted["channels"] = ",".join(CHANNELS_OF_NIRC.get(n, n) for n in names)
        if "learning_rate" in wanted:  # that of an incident cache
            wanted["learning_rate"] *= 6.0
    return mi.load_dict({"type": "neural_path", **wanted})


#: Keys of integrators that may query the weights being trained, and their rows.
BLEND_NAMES = (
    "blend", "reliability", "reliability_normals", "reliability_decay",
    "reliability_warm_up", "reliability_kappa", "reliability_epsilon", "reliability_resolution",
)  # fmt: skip
BLEND_KEYS = """
     * - blend
       - |string|
       - Which weights queries use. ``ema``: their average over training frames; least noise, but late after a change.
         ``fast``: the weights being trained. ``reliability``: (1 - σ) times the average's prediction plus σ times that
         of the trained weights; σ depends on the place and on how well both agree with the training records. It
         follows a change as ``fast`` does, with the noise of ``ema`` elsewhere. ``switch``: the same with σ rounded to
         0 or 1. In scenes that do not change ``ema`` is best. (Default: ema)
     * - reliability
       - |string|
       - How σ is computed: ``evidence`` (a test whether the trained weights are better), ``correlation`` (as
         published), ``concordance``, ``regression``. (Default: evidence)
     * - reliability_normals
       - |bool|
       - Keep statistics apart by the six main directions of the normal. (Default: false)
     * - reliability_decay
       - |float|
       - Decay λ of the statistics per frame, in [0, 1). (Default: 0.9)
     * - reliability_warm_up
       - |int|
       - Number K of training frames at the start in which σ stays 0. (Default: 128)
     * - reliability_kappa
       - |float|
       - How sharply σ decides: factor κ of the difference between the two predictors' ``correlation`` or
         ``concordance`` with the records. (Default: 4)
     * - reliability_epsilon
       - |float|
       - Constant ε that ``correlation`` and ``concordance`` add to variances, in units of the squared mean radiance of
         the scene. (Default: 0.001)
     * - reliability_resolution
       - |int|
       - Number of cells of the statistics along the longest axis of the box of the records. (Default: 16)"""


SHARED_KEYS = (
    """
     * - max_depth
       - |int|
       - Longest *traced* path in segments; -1 means no limit. Up to 2 the result is that of ``path`` (no cache is
         queried). Beyond, light from the cache has been reflected any number of times: compare with an unlimited
         ``path``. (Default: -1)
     * - rr_depth
       - |int|
       - Path depth from which Russian roulette may end a traced path. (Default: 5)
     * - hide_emitters
       - |bool|
       - Leave out what the camera sees of emitters directly. (Default: false)
     * - train_frames
       - |int|
       - Training frames before the first image; -1: until the loss hardly falls any more, 128 to 400. (Default: -1)
     * - train_samples
       - |int|
       - Training paths per frame; -1: one for each 8x8 pixels of the film. (Default: 4096, ``nrc`` and ``neural_path``
         2048, on a GPU 8192)
     * - train_vertices
       - |int|
       - Vertices of a training path. Each but the last is a record; at the last the cache itself is read. (Default: 8)
     * - train_steps
       - |int|
       - Training frames before each later image, so that the cache follows a changing scene. (Default: 1)
     * - learning_rate
       - |float|
       - Learning rate of Adam at the start; it falls by ``last_rate``. (Default: 0.01, ``nrc`` and ``neural_path``
         0.06, but ``nrc`` 0.01 with a ``blend`` other than ``ema``)
     * - epsilon
       - |float|
       - The loss is relative: epsilon is added to the square by which it divides, in units of the squared mean radiance
         of the scene. (Default: 10, ``nrc`` and ``neural_path`` 1)
     * - ema_decay
       - |float|
       - Decay per training frame of the averaged weights that queries use. It is less in the first frames. (Default:
         0.99)
     * - ema_debiased
       - |bool|
       - Average over all steps so far, with weights that fall by ``ema_decay`` a step, as published; false: over the
         last seventh of them at most. (Default: false)
     * - freeze_cache
       - |bool|
       - Do not train at all; an untrained cache predicts a constant. (Default: false)
     * - gradient
       - |string|
       - How derivatives of images are computed (``dr.backward(mi.render(scene, params, integrator=...))``). ``cache``:
         paths read the light at each vertex from the cache; little noise, and the bias of the cache. ``traced``: the
         light is traced by the rest of the path (path replay), with the lights that ``light_sampler`` chooses;
         unbiased, and the cache is not used. ``prb``: Mitsuba's ``prb`` with the same ``max_depth``, ``rr_depth`` and
         ``hide_emitters``; unbiased. Derivatives of shapes and sensors always use ``prb``. (Default: cache; in
         ``nirc_two_level`` traced)
     * - seed
       - |int|
       - Seed of the initial weights and the training paths. (Default: 0)
     * - levels
       - |int|
       - Levels of the hash grid, two features each. (Default: 8)
     * - hashmap_size
       - |int|
       - Largest number of entries of a level. (Default: 32768)
     * - width
       - |int|
       - Width of the network's hidden layers. (Default: 16; of ``nrc`` and ``neural_path`` 32)
     * - hidden_layers
       - |int|
       - Number of hidden layers. (Default: 2)
     * - last_rate
       - |float|
       - Share of ``learning_rate`` at the end of its fall. (Default: 0.1; with a ``blend`` other than ``ema`` 1, so
         that the trained weights follow a change)
"""
    + LIGHT_SAMPLER_KEY.strip("\n")
    + """
     * - plan
       - |string|
       - What is built. ``scene``: what the scene needs; keys of this table override it, and ``mi-neural plan SCENE``
         says what is built and why. ``everything``: all parts, to compare and to look for faults. (Default: scene)
     * - channels
       - |string|
       - Extra channels to write, a comma-separated list of those named below. (Default: none)
"""
)
