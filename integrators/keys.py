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


#: Keys of whole numbers that have no default of their own.
WHOLE = ("levels", "hashmap_size", "width", "hidden_layers", "cache_samples", "residual_samples", "train_records")


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
        if name in WHOLE and default is None and value is not None:
            default = 0
        if isinstance(default, bool):
            self._check(isinstance(value, bool), name, value, "true or false")
        elif isinstance(default, int):
            whole = isinstance(value, int | float) and not isinstance(value, bool) and value == int(value)
            self._check(whole, name, value, "a whole number")
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
    wanted = {key: keys[key] for key in keys.props.keys() if key not in WITHOUT_MEANING}
    for key in WITHOUT_MEANING:
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
       - Training frames before the first image; -1: until the loss settles, 128 to 400. (Default: -1)
     * - train_samples
       - |int|
       - Training paths per frame; -1: one for each 8x8 pixels of the film. (Default: 4096, ``nrc`` and ``neural_path``
         2048, on a GPU 8192)
     * - train_vertices
       - |int|
       - Vertices of a training path, each but the last a record; it ends in the cache itself. (Default: 8)
     * - train_steps
       - |int|
       - Training frames before each later image, so that the cache follows a changing scene. (Default: 1)
     * - learning_rate
       - |float|
       - Of Adam, at the start; falls to a tenth. (Default: 0.01, ``nrc`` and ``neural_path`` 0.06, but ``nrc`` 0.01
         with a ``blend`` other than ``ema``)
     * - epsilon
       - |float|
       - Of the loss, which is relative: added to the square that the error is divided by, in units of the squared mean
         radiance of the scene. (Default: 10, ``nrc`` and ``neural_path`` 1)
     * - ema_decay
       - |float|
       - Decay per frame of the averaged weights that queries use, once training is old enough. (Default: 0.99)
     * - ema_debiased
       - |bool|
       - Average over all steps so far, with weights that fall by ``ema_decay`` a step, as published; false: over the
         last seventh of them at most. (Default: false)
     * - freeze_cache
       - |bool|
       - Do not train at all; an untrained cache predicts a constant. (Default: false)
     * - gradient
       - |string|
       - Where derivatives of images come from, as in ``dr.backward(mi.render(scene, params, integrator=...))``.
         ``cache``: paths that read the incident radiance at each vertex from the cache: little noise, as much bias as
         the cache has. ``prb``: Mitsuba's ``prb`` with the same ``max_depth``, ``rr_depth`` and ``hide_emitters``:
         unbiased. Shapes and sensors always take the latter. (Default: cache; in ``nirc_two_level`` prb)
     * - seed
       - |int|
       - Of the initial weights and the training paths. (Default: 0)
     * - levels
       - |int|
       - Levels of the hash grid, two features each. (Default: 8)
     * - hashmap_size
       - |int|
       - Most entries of a level. (Default: 32768)
     * - width
       - |int|
       - Of the network's hidden layers. (Default: 32)
     * - hidden_layers
       - |int|
       - Their number. (Default: 2)
     * - blend
       - |string|
       - Which weights answer. ``ema``: their average, least noise, lags behind changes. ``fast``: those being trained.
         ``reliability``: (1 - σ) average + σ trained, σ by place from how both agree with the training records; as
         quick as ``fast`` where light changes, as still as ``ema`` elsewhere. ``switch``: the same with σ rounded to 0
         or 1. For scenes that change; in still ones ``ema`` is best. (Default: ema)
     * - reliability
       - |string|
       - How σ is found: ``evidence`` (a test whether the trained weights are better), ``correlation``, ``concordance``,
         ``regression``. (Default: evidence)
     * - reliability_normals
       - |bool|
       - Keep statistics apart by the six main directions of the normal. (Default: false)
     * - reliability_decay
       - |float|
       - What a frame leaves of the statistics before it, λ, in [0, 1). (Default: 0.9)
     * - reliability_warm_up
       - |int|
       - Training frames in which σ stays 0, K. (Default: 128)
     * - reliability_kappa
       - |float|
       - Gain κ of σ by how far the two predictors' ``correlation`` or ``concordance`` with the records are apart.
         (Default: 4)
     * - reliability_epsilon
       - |float|
       - ε, added to variances by ``correlation`` and ``concordance``, in units of the squared mean radiance of the
         scene. (Default: 0.001)
     * - reliability_resolution
       - |int|
       - Cells of the statistics along the longest axis of the box where records fall. (Default: 16)
     * - last_rate
       - |float|
       - Share of ``learning_rate`` that it falls to. (Default: 0.1 with ``ema``, else 1: the trained weights must be
         quick)
"""
    + LIGHT_SAMPLER_KEY.strip("\n")
    + """
     * - plan
       - |string|
       - What is built. ``scene``: what the scene needs (``mi-neural plan SCENE`` says what and why; keys of this table
         have the last word). ``everything``: whatever it needs, to compare and to look for faults. (Default: scene)
     * - channels
       - |string|
       - Extra channels to write, a comma-separated list; the plugin says which. (Default: none)
"""
)
