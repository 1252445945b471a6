"""From what a user typed to an integrator of Mitsuba: `nirc:cache_samples=8` with typed keys.

Everything here raises :class:`~mi_neural.bench.load.InputError` with one line that says what is wrong and what to type.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from .load import InputError, one_line, unreferenced

#: Mitsuba's own integrators, named in the error for an unknown one.
MITSUBA_INTEGRATORS = "path direct volpath volpathmis ptracer aov depth moment stokes prb prb_basic prbvolpath".split()


@dataclass
class IntegratorSpec:
    """An integrator as typed: `nirc` or `nirc:cache_samples=8,termination=primary`."""

    type: str
    keys: dict[str, object] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """How the integrator is called in tables: as it was typed."""
        keys = ",".join(f"{k}={format_value(v)}" for k, v in self.keys.items())
        return f"{self.type}:{keys}" if keys else self.type


def file_name(label: str) -> str:
    """The name of what is written for an integrator of this label: `nirc_cache_samples-8`."""
    return re.sub(r"[^\w.-]+", "_", label.replace("=", "-"))


def require_distinct(labels: list[str], of: str) -> None:
    """Raise :class:`InputError` where two labels have one :func:`file_name`; `of`: what would be shared."""
    known: dict[str, str] = {}
    for label in labels:
        name = file_name(label)
        if name in known:
            raise InputError(f"{known[name]!r} and {label!r} would share {of} {name}: leave one of them out")
        known[name] = label


def parse_integrator(text: str) -> IntegratorSpec:
    """Read `type` or `type:key=value,key=value`."""
    name, _, keys = text.partition(":")
    if not re.fullmatch(r"\w+", name):
        raise InputError(f"-i takes TYPE or TYPE:key=value,key=value, got {text!r}")
    return IntegratorSpec(name, parse_keys(keys.split(",") if keys else [], "-i"))


def parse_keys(texts: list[str], option: str = "--set") -> dict[str, object]:
    """Read `key=value` texts: true and false, integers, floats, otherwise text."""
    keys = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not re.fullmatch(r"\w+(\.\w+)*", key.strip()):
            raise InputError(f"{option} takes key=value, got {text!r}")
        keys[key.strip()] = parse_value(value.strip())
    return keys


def parse_value(text: str) -> bool | int | float | str:
    """`true`/`false` to bool, `8` to int, `0.5` and `1e-3` to float, anything else stays text."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def format_value(value: object) -> str:
    """The inverse of :func:`parse_value`."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def build_integrator(
    spec: IntegratorSpec, carried: dict[str, object] | None = None, optional: dict[str, object] | None = None
) -> tuple[object, dict[str, object]]:
    """Make the integrator of a spec; returns it with the keys it was given.

    `carried` and `optional` keys are given where the integrator knows them and dropped where not; those of the spec win
    over both and must be known. A dotted key reaches into a nested plugin: `light_sampler.type=nvc_lights`.

    Raises :class:`InputError` for an unknown integrator or key, or a value of the wrong type.
    """
    import mitsuba as mi

    droppable = {**(carried or {}), **(optional or {})}
    keys = {**droppable, **spec.keys}
    while True:
        try:
            integrator = mi.load_dict({"type": spec.type, **_nested(keys)})
            break
        except (RuntimeError, TypeError, ValueError) as error:
            text = one_line(error)
        if f'Plugin "{spec.type}" not found' in text:
            raise InputError(f"unknown integrator {spec.type!r}; {_known_integrators()}")
        unknown, refused = unreferenced(text), re.findall(r": it has no key '(\w+)'; ", text)
        dropped = [k for k in unknown + refused if k in droppable and k not in spec.keys]
        if dropped and len(dropped) == len(unknown + refused):
            keys = {k: v for k, v in keys.items() if k not in dropped}
            continue
        if wrong := [k for k in unknown if k not in dropped]:
            raise InputError(f"{spec.type} has no key {', '.join(map(repr, wrong))}")
        if "is not a light sampler" in text:
            raise InputError(f"{spec.label}: name the light sampler by light_sampler.type, as in "
                             f"-i {spec.type}:light_sampler.type=tree_lights")  # fmt: skip
        text = re.sub(r'^At dictionary node "\w+": failed to instantiate .*? of type "\w+": ', "", text)
        raise InputError(f"cannot make the integrator {spec.label!r}: {text}")
    if not isinstance(integrator, mi.Integrator):
        raise InputError(f"{spec.type!r} is no integrator; {_known_integrators()}")
    return integrator, keys


def _nested(keys: dict[str, object]) -> dict[str, object]:
    result: dict[str, object] = {}
    for key, value in keys.items():
        *outer, last = key.split(".")
        target = result
        for part in outer:
            target = target.setdefault(part, {})
            if not isinstance(target, dict):
                raise InputError(f"key {key!r}: {part!r} is also given a value of its own")
        target[last] = value
    return result


def _known_integrators() -> str:
    """The two lists that the error for an unknown integrator ends with."""
    from mi_neural import integrators
    from mi_neural.registration import plugin_names

    ours = plugin_names(integrators)
    own = f"of this package: {', '.join(ours)}; " if ours else ""
    return f"{own}of Mitsuba: {', '.join(MITSUBA_INTEGRATORS)}"
