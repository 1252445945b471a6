"""Keys of integrators that train a cache: its sizes, its training, and which of its weights answer."""

from __future__ import annotations

from dataclasses import replace

from mi_neural import plan
from mi_neural.caches.incident import IncidentCache, Training
from mi_neural.caches.weights import FieldShape
from mi_neural.integrators import planning
from mi_neural.integrators.base import FilmIntegrator
from mi_neural.integrators.blending import Blending
from mi_neural.integrators.keys import BLEND_NAMES

#: `train_samples` that stands for a training path for each tile of so many pixels a side.
BY_TILES, TILE = -1, 8


def _in_keys(message: str) -> str:
    """A message of the library in the words of the plugin's keys."""
    names = {"n_paths": "train_samples", "n_vertices": "train_vertices", **{v: k for k, v in planning.SIZES.items()}}
    for name, key in names.items():
        message = message.replace(name, key)
    return message


class LearningIntegrator(FilmIntegrator):
    """Base of :class:`~mi_neural.integrators.common.CacheIntegrator`: makes the cache that the keys describe."""

    def __init__(self, props):
        super().__init__(props)
        self.train_frames = props.get("train_frames", -1)
        self.seed = props.get("seed", 0)
        self._check(self.train_frames >= -1, f"train_frames is {self.train_frames}; give -1 (until settled), 0 or more")
        self._check(self.seed >= 0, f"seed is {self.seed}; it must be 0 or more")
        self.plan_mode = props.get("plan", "scene")
        self._check(self.plan_mode in plan.MODES, f"plan is '{self.plan_mode}'; give one of: {', '.join(plan.MODES)}")
        blending = self.blending(props)
        try:
            training = self._training(props, blending)
            sizes = {"levels": props.get("levels", None), "hashmap_size": props.get("hashmap_size", None),
                     "width": props.get("width", None), "hidden_layers": props.get("hidden_layers", None)}  # fmt: skip
            self.given = {k: v for k, v in sizes.items() if v is not None}
            sizes = {planning.SIZES[k]: v for k, v in self.given.items()}
            shape = FieldShape(**{**self.shape_keys(props), **sizes})
        except ValueError as e:
            message = str(e).removeprefix(f"{self.plugin}: ")
            raise ValueError(f"{self.plugin}: {_in_keys(message)}") from None
        self.cache = IncidentCache(
            training, shape, seed=self.seed, blend=blending.blend, reliability=blending.reliability
        )

    def _training(self, props, blending: Blending) -> Training:
        """Constants of training; ValueError, in the words of their fields, for one out of range."""
        n_paths = props.get("train_samples", self.default_paths())
        self.by_tiles = n_paths == BY_TILES
        return Training(
            n_paths=self.default_paths() if self.by_tiles else n_paths,
            n_vertices=props.get("train_vertices", 8),
            learning_rate=props.get("learning_rate", self.default_rate(blending.blend)),
            last_rate=props.get("last_rate", blending.last_rate),
            ema_decay=props.get("ema_decay", 0.99),
            ema_debiased=props.get("ema_debiased", False),
            epsilon=props.get("epsilon", self.default_epsilon()),
            **self.training_keys(props),
        )

    def fit_paths(self, sensor) -> None:
        """With `train_samples` = -1, as many training paths as the film has tiles, but two at least."""
        if not self.by_tiles or not hasattr(sensor, "film"):
            return
        width, height = (int(n) for n in sensor.film().crop_size())
        n = max(2, -(-width // TILE) * -(-height // TILE))
        if n != self.cache.training.n_paths:
            self.cache.training = replace(self.cache.training, n_paths=n)
            self.cache.clear_recordings()

    # -------------------------------------------------------------------------------------------------------------
    # To be given by the plugin

    def training_keys(self, props) -> dict:
        """Constants of :class:`~mi_neural.caches.incident.Training` that keys of the plugin's own set."""
        return {}

    def shape_keys(self, props) -> dict:
        """Sizes of :class:`~mi_neural.caches.weights.FieldShape` that keys of the plugin's own set."""
        return {}

    def default_epsilon(self) -> float:
        """The constant of the loss where no key says it."""
        return Training.epsilon

    def blending(self, props) -> Blending:
        """Which weights answer queries. Refuses the keys that say it, where the average always does."""
        props.refuse(BLEND_NAMES, "nirc and nrc have it")
        return Blending()

    def default_paths(self) -> int:
        """Training paths a step where no key says it."""
        return Training.n_paths

    def default_rate(self, blend: str) -> float:
        """The learning rate where no key says it."""
        return Training.learning_rate
