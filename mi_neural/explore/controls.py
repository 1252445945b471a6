"""What can be moved while one looks: the camera, the lights, an integrator's keys. No widgets here."""

from __future__ import annotations

import re
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mi_neural.bench import changes

#: What a light shines with, in Mitsuba's names; textures' values are multiplied.
BRIGHTNESS = re.compile(r"(radiance|irradiance|intensity)\.(value|data)|scale|sun_scale|sky_scale")
#: Emitters whose place does not matter, only how they are turned.
INFINITE = ("DirectionalEmitter", "EnvironmentMapEmitter", "ConstantBackgroundEmitter", "SunskyEmitter")


class Camera:
    """A sensor on a sphere around what it looks at.

    `target` is what the centre of the first picture shows (the middle of the scene where it shows nothing). The
    sphere's axis is the axis of the scene that is nearest to the camera's own up.
    """

    def __init__(self, scene, sensor: int = 0) -> None:
        self.params = mi.traverse(scene.sensors()[sensor])
        if "to_world" not in self.params:
            raise ValueError(f"sensor {sensor} has no to_world and cannot be moved")
        self.place = changes.Parameter(self.params, "to_world")
        self.start = self.place.value
        self.target = _looked_at(scene, scene.sensors()[sensor], self.start)
        self.up = _nearest_axis(self.start[:3, 1])
        self.azimuth = self.elevation = 0.0
        self.distance = 1.0
        self.set()

    def set(self, azimuth: float | None = None, elevation: float | None = None, distance: float | None = None) -> None:
        """Go to `azimuth` and `elevation`, in degrees from where the camera was at first, and `distance` times as far
        away; None: as it is. The camera stays 1 degree off the poles."""
        self.azimuth = self.azimuth if azimuth is None else float(azimuth)
        self.distance = self.distance if distance is None else max(float(distance), 1e-3)
        away = self.start[:3, 3] - self.target
        height = np.degrees(np.arcsin(np.clip(away @ self.up / max(np.linalg.norm(away), 1e-30), -1, 1)))
        wanted = self.elevation if elevation is None else float(elevation)
        self.elevation = float(np.clip(wanted, min(0.0, -89 - height), max(0.0, 89 - height)))
        turn = changes.rotate(self.up, self.azimuth, self.target)
        # Columns of a camera's matrix: left, up, forward, place; to rise is to turn about the left axis
        turn = turn @ changes.rotate(self.start[:3, 0], self.elevation, self.target)
        near = self.start.copy()
        near[:3, 3] = self.target + self.distance * away
        self.place.set(turn @ near)
        self.params.update()

    @property
    def moved(self) -> bool:
        """Whether the camera is elsewhere than at first."""
        return (self.azimuth, self.elevation, self.distance) != (0.0, 0.0, 1.0)


class Light:
    """One emitter: how bright, of which colour, where, turned how. `name` is its key in ``mi.traverse(scene)``.

    colour      at first: linear RGB of largest value 1, None where the light has no colour to set
    now         the arguments of the latest :meth:`set`
    can_move    it has a place
    can_turn    it has a direction
    """

    def __init__(self, params, name: str, infinite: bool, brightness: str, known: dict, up: np.ndarray) -> None:
        self.params, self.name, self.up = params, name, up
        self.glow = known[f"{name}.{brightness}"]()
        value = self.glow.value
        peak = float(value.max(initial=0.0)) if value.shape == (3,) else 1.0
        self.colour = (value / peak if peak > 0 else np.ones(3)) if value.shape == (3,) else None
        self._level = peak if value.shape == (3,) else value
        shape = name.rpartition(".")[0]
        places = (f"{name}.position", f"{name}.to_world", f"{shape}.to_world")
        key = next((k for k in places if k in known), None)
        self.place = known[key]() if key else None
        self.can_move = self.place is not None and not infinite
        self.can_turn = self.place is not None and self.place.value.shape == (4, 4)
        self._middle = self._centre() if self.place is not None else np.zeros(3)
        self._assign()

    def _centre(self) -> np.ndarray:
        """What the light is turned about."""
        if isinstance(self.place, changes.MeshPlacement):
            return 0.5 * (self.place.positions.min(axis=0) + self.place.positions.max(axis=0))
        return self.place.value if self.place.value.shape == (3,) else self.place.value[:3, 3]

    def set(self, stops: float = 0.0, colour=None, offset=(0.0, 0.0, 0.0), azimuth: float = 0.0,
            elevation: float = 0.0) -> None:  # fmt: skip
        """2^`stops` times as bright as at first, of `colour` (linear RGB, its largest value counting as 1), moved by
        `offset` in world units, turned by degrees about the vertical axis (the camera's) and the light's own x axis.

        What the light cannot do is left out.
        """
        self._assign(stops, colour, offset, azimuth, elevation)
        self.params.update()

    def _assign(self, stops=0.0, colour=None, offset=(0.0, 0.0, 0.0), azimuth=0.0, elevation=0.0) -> None:
        """:meth:`set` without the update of the scene."""
        if self.colour is not None:
            colour = self.colour if colour is None else np.asarray(colour, float) / max(np.max(colour), 1e-6)
            self.glow.set(2.0**stops * self._level * colour)
        else:
            self.glow.set(2.0**stops * self._level)
        if self.can_turn:
            matrix = self.place.value
            own_x = matrix[:3, 0] / np.linalg.norm(matrix[:3, 0])
            turn = changes.rotate(self.up, azimuth, self._middle) @ changes.rotate(own_x, elevation, self._middle)
            self.place.set((changes.translate(offset) if self.can_move else np.eye(4)) @ turn @ matrix)
        elif self.can_move:
            self.place.set(self.place.value + np.asarray(offset, float))
        self.now = {"stops": stops, "colour": colour, "offset": tuple(offset), "azimuth": azimuth,
                    "elevation": elevation}  # fmt: skip

    @property
    def moved(self) -> bool:
        """Whether anything is other than at first."""
        now = dict(self.now)
        colour = now.pop("colour")
        recoloured = self.colour is not None and not np.allclose(colour, self.colour, atol=1e-3)
        return recoloured or any(np.any(v) for v in now.values())


def lights(scene, up=(0.0, 1.0, 0.0)) -> list[Light]:
    """The scene's emitters that have something to set, in the order of ``mi.traverse(scene)``; `up` is vertical.

    From here on what they set are variables, which kernels read, and no constants that are compiled.
    """
    params = mi.traverse(scene)
    known, found = changes.keys(params), {}
    emitters = {emitter.class_name() for emitter in scene.emitters()}
    for key in known:
        owner, name = _light_of(key)
        if name and owner not in found:
            node = params.properties.get(f"{owner}.sampling_weight", (None, None, None, 0))[2]
            if node is not None and node.class_name() in emitters:
                found[owner] = Light(params, owner, node.class_name() in INFINITE, name, known, np.asarray(up, float))
    if found:
        params.update()
    return list(found.values())


def _light_of(key: str) -> tuple[str, str | None]:
    """('lamp.emitter', 'radiance.value') of 'lamp.emitter.radiance.value'; (key, None) where it is no brightness."""
    parts = key.split(".")
    for n in (2, 1):
        name = ".".join(parts[-n:])
        if len(parts) > n and BRIGHTNESS.fullmatch(name):
            return ".".join(parts[:-n]), name
    return key, None


def _looked_at(scene, sensor, to_world: np.ndarray) -> np.ndarray:
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.5, 0.5), mi.Point2f(0.5, 0.5))
    si = scene.ray_intersect(ray)
    if bool(si.is_valid()[0]):
        return np.array(si.p, np.float64).ravel()
    box = scene.bbox()
    middle = 0.5 * (np.array(box.min, np.float64).ravel() + np.array(box.max, np.float64).ravel())
    origin, forward = to_world[:3, 3], to_world[:3, 2] / np.linalg.norm(to_world[:3, 2])
    return origin + max((middle - origin) @ forward, 1e-3) * forward


def _nearest_axis(v: np.ndarray) -> np.ndarray:
    axis = np.zeros(3)
    k = int(np.abs(v).argmax())
    axis[k] = 1.0 if v[k] >= 0 else -1.0
    return axis


# ------------------------------------------------------------------------------------------------------------------
# Keys of integrators


@dataclass(frozen=True)
class Setting:
    """A key of an integrator that may be set while it renders, and values that are worth trying.

    `only`: the plugins in which it may; none: all that have it.
    """

    name: str
    values: tuple
    only: tuple[str, ...] = ()

    def applies(self, integrator) -> bool:
        """Whether `integrator` has the key and can change it."""
        own = getattr(integrator, self.name, None)
        known = own in self.values if isinstance(own, str) else type(own) in (bool, int, float)
        return known and (not self.only or getattr(integrator, "plugin", None) in self.only)

    def choices(self, integrator) -> tuple:
        """The values, the integrator's own among them."""
        own = getattr(integrator, self.name)
        return self.values if own in self.values else tuple(sorted((*self.values, own)))


#: Keys that take effect with the next image.
SETTINGS = (
    Setting("termination", ("adaptive", "primary", "spread", "balanced", "balanced_shares"), only=("nirc",)),
    Setting("cache_samples", (1, 2, 4, 8, 16), only=("nirc",)),
    Setting("light_samples", (-1, 1, 2, 4, 8), only=("nirc",)),
    Setting("gather_half", (0.0, 1.0, 4.0, 16.0, 64.0)),
    Setting("spread_threshold", (0.0, 1e-3, 1e-2, 0.1, 1.0)),
    Setting("max_depth", (-1, 1, 2, 3, 4, 8, 16)),
    Setting("initial_candidates", (1, 2, 4, 8, 16, 32)),
    Setting("spatial_samples", (0, 1, 2, 4, 8)),
    Setting("history", (1.0, 5.0, 20.0, 80.0)),
    Setting("train_steps", (0, 1, 2, 4, 8)),
    Setting("freeze_cache", (False, True)),
)


def settings(integrator) -> list[Setting]:
    """Those of SETTINGS that `integrator` has and can change."""
    return [s for s in SETTINGS if s.applies(integrator)]
