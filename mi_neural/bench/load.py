"""From what a user typed to Mitsuba objects: scenes with another film size, integrators with typed keys.

Everything here raises :class:`InputError` with one line that says what is wrong and what to type.
"""

from __future__ import annotations

import difflib
import hashlib
import os
import re
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

#: Keys taken over from the scene's own integrator, so that another one is compared at equal depth.
CARRIED_KEYS = ("max_depth", "rr_depth", "hide_emitters")
#: Mitsuba's own integrators, named in the error for an unknown one.
MITSUBA_INTEGRATORS = "path direct volpath volpathmis ptracer aov depth moment stokes prb prb_basic prbvolpath".split()


class InputError(ValueError):
    """What the user typed cannot be done; the message is one line and complete."""


def user_path(path: str | Path) -> Path:
    """A path as a user typed it: `~` at its start is the user's home, `~name` that of a user of this name, if any."""
    return Path(os.path.expanduser(path))


# ------------------------------------------------------------------------------------------------------------------
# Scenes


@dataclass
class LoadedScene:
    """A scene with what is needed to name it, find it again and give its integrator's keys to another.

    name        as typed, without folder and suffix unless the file is called `scene.xml`, which takes its folder's name
    path        the XML file
    parameters  values given for the scene's `$parameters`
    digest      SHA-256 of the XML file, of what it includes, and of the meshes, textures and other files that it names
    carried     `max_depth`, `rr_depth`, `hide_emitters` of the scene's own integrator, as far as it sets them
    integrator  plugin name of the scene's own integrator
    merged      whether Mitsuba joined meshes and equal materials, so that some lost their names
    """

    scene: object = field(repr=False)
    name: str
    path: Path
    parameters: dict[str, str]
    digest: str
    carried: dict[str, object]
    integrator: str
    merged: bool = True

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of what is rendered, in pixels."""
        return tuple(int(n) for n in self.scene.sensors()[0].film().crop_size())

    @property
    def box_filter(self) -> bool:
        """Whether a pixel is the mean over its square, so that means of pixels are larger pixels."""
        return self.scene.sensors()[0].film().rfilter().is_box_filter()

    @property
    def default_spp(self) -> int:
        """Samples a pixel that the scene file asks for."""
        return max(1, int(self.scene.sensors()[0].sampler().sample_count()))


def find_scene(name: str) -> Path:
    """The XML file for `name`: a file, one of the shipped scenes, or a public one that was got (`mi-neural scenes`).

    Raises :class:`InputError` for others, with what to type.
    """
    from mi_neural import scenes
    from mi_neural.scenes import public

    path = user_path(name)
    if path.is_file():
        return path.resolve()
    shipped, of_others = list(scenes.names()), public.names()
    if name in shipped or (name in of_others and public.file(name).is_file()):
        return scenes.path(name).resolve()
    if path.is_dir():
        hint = next((str(p) for p in sorted(path.glob("*.xml"))), None)
        raise InputError(f"{name} is a folder, not a scene file" + (f": try {hint}" if hint else ""))
    if name in of_others:
        raise InputError(f"the public scene {name} is not on this machine: type mi-neural scenes get "
                         f"{name.partition('/')[0]}")  # fmt: skip
    if name in public.SCENES:
        raise InputError(f"{name} has several scene files: {', '.join(n for n in of_others if n.startswith(name))}")
    close = difflib.get_close_matches(name, shipped + of_others, 1)
    raise InputError(
        f"no scene file {name!r}"
        + (f", did you mean {close[0]!r}?" if close else "")
        + (f"; shipped scenes: {', '.join(shipped)}" if shipped else "")
        + f"; public ones: {', '.join(of_others)}"
    )


def load_scene(
    name: str,
    size: tuple[int, int] | list[tuple[int, int]] | None = None,
    parameters: dict[str, str] | None = None,
    integrator_keys: dict[str, object] | None = None,
    merge: bool = True,
) -> LoadedScene:
    """Load a scene file or shipped scene under the active variant.

    size             (width, height) for the film of every sensor, of several the one whose shape is nearest to that of
                     the scene's own film; a crop window is dropped
    parameters       values for the scene's `$parameters`
    integrator_keys  keys to set on the scene's own integrator
    merge            let Mitsuba join meshes and equal materials, as it does by default: in scenes of thousands of
                     shapes the first image takes a third of the time. Without it each keeps its name, and an edit of
                     one material reaches no other. Where they cannot be joined, they are not

    Raises :class:`InputError` for an unknown scene, a parameter the scene does not have, an unknown key, a scene that
    Mitsuba cannot load or that has an empty film.
    """
    import mitsuba as mi

    path = find_scene(name)
    parameters = {k: str(v) for k, v in (parameters or {}).items()}
    config = mi.parser.ParserConfig(mi.variant())
    # Not in parallel: threads would number the scene's parts in another order each time, and no cached kernel of an
    # earlier process would match, which costs ten seconds with OptiX. What takes long, acceleration structures and
    # large files, is no slower
    config.parallel = False

    def parse():
        state = mi.parser.parse_file(config, str(path), **parameters)
        _set_film_size(state, size)
        own = _own_integrator(state)
        for key, value in (integrator_keys or {}).items():
            if own is None:
                raise InputError(f"{path.name} names no integrator to set {key!r} on: choose one with -i")
            own.props[key] = value
        # Taken now: nodes that are added to the list later move the others, and `own` would be no node any more
        carried = {k: own.props[k] for k in CARRIED_KEYS if own is not None and k in own.props}
        return state, carried, own.props.plugin_name() if own is not None else "path"

    def make(state):
        config.merge_meshes, config.merge_equivalent = False, merge
        mi.parser.transform_all(config, state)
        if merge:
            _merge_meshes(state)
        made = mi.parser.instantiate(config, state)
        return made[0] if isinstance(made, (list, tuple)) else made

    with _resolving(path.parent), _readable(path, parameters):
        state, carried, integrator = parse()
        digest = _digest(state)
        try:
            scene = make(state)
        except RuntimeError:
            if not merge:
                raise
            merge = False
            state, *_ = parse()
            scene = make(state)  # fails in the same way where merging was not the reason

    if not isinstance(scene, mi.Scene):
        raise InputError(f"{path} is no scene: its outermost element must be <scene>")
    if not scene.sensors():
        raise InputError(f"{path} has no sensor: add <sensor type='perspective'>")
    return LoadedScene(
        scene=scene,
        name=path.parent.name if path.stem == "scene" else path.stem,
        path=path,
        parameters=parameters,
        digest=digest,
        carried=carried,
        integrator=integrator,
        merged=merge,
    )


def _merge_meshes(state) -> None:
    """Let Mitsuba join the meshes of a scene, those of emitters and sensors excepted.

    `transform_merge_meshes` hands over everything, and what it made is in the order of addresses in memory, another in
    each process. So the same seed gave another image wherever the order of emitters matters.
    """
    import mitsuba as mi

    root, apart = state.root, (mi.ObjectType.Emitter, mi.ObjectType.Sensor)

    def children(props) -> dict:
        kind = mi.Properties.Type.ResolvedReference
        return {name: state.nodes[props[name].index()] for name in props.keys() if props.type(name) == kind}

    plain = [name for name, node in children(root.props).items() if node.type == mi.ObjectType.Shape
             and not any(child.type in apart for child in children(node.props).values())]  # fmt: skip
    if root.type != mi.ObjectType.Scene or not plain:
        return
    merged = mi.parser.SceneNode()
    merged.type, merged.props = mi.ObjectType.Shape, mi.Properties("merge")
    for name in plain:
        merged.props[name] = root.props[name]
        del root.props[name]
    root.props["_arg_merged"] = mi.Properties.ResolvedReference(len(state.nodes))
    state.nodes.append(merged)


def scene_parameters(path: Path) -> list[str]:
    """Names of the `$parameters` that a scene file declares or uses, sorted."""
    text = path.read_text(errors="replace")
    declared = re.findall(r"<default\s+name\s*=\s*[\"'](\w+)", text)
    return sorted(set(declared) | set(re.findall(r"\$(\w+)", text)))


def _digest(state) -> str:
    """SHA-256 of all files that a parsed scene consists of: XML, and what is named by `filename` and is there."""
    import mitsuba as mi

    named = [str(node.props["filename"]) for node in state.nodes if "filename" in node.props]
    found = [Path(str(mi.file_resolver().resolve(name))) for name in dict.fromkeys(named)]
    digest = hashlib.sha256()
    for file in (*(Path(str(name)) for name in state.files), *found):
        if file.is_file():
            digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def _set_film_size(state, size: tuple[int, int] | list[tuple[int, int]] | None) -> None:
    import mitsuba as mi

    if size is None:
        return
    films = [node for node in state.nodes if node.type == mi.ObjectType.Film]
    if isinstance(size, list):
        own = films[0].props if films else {}
        width, height = (int(own[key]) if key in own else n for key, n in (("width", 768), ("height", 576)))
        size = min(size, key=lambda s: abs(np.log(s[0] * height / (s[1] * width))))
    for node in films:
        node.props["width"], node.props["height"] = size
        for key in ("crop_width", "crop_height", "crop_offset_x", "crop_offset_y"):
            if key in node.props:
                del node.props[key]


def _own_integrator(state):
    """The integrator node that the scene itself holds, or None. The root comes first, then its children in order."""
    import mitsuba as mi

    return next((node for node in state.nodes if node.type == mi.ObjectType.Integrator), None)


@contextmanager
def _resolving(folder: Path):
    """Let relative file names in a scene be found beside it, and leave the user's search path as it was."""
    import mitsuba as mi

    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(str(folder))
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


@contextmanager
def _readable(path: Path, parameters: dict[str, str]):
    """Turn what Mitsuba raises while loading into one line."""
    try:
        yield
    except InputError:
        raise
    except (RuntimeError, TypeError, ValueError) as error:
        text = one_line(error)
        if unused := re.findall(r"\$(\w+)=", text) if "unused parameters" in text else []:
            known = ", ".join(scene_parameters(path)) or "none"
            raise InputError(f"{path.name} has no parameter {', '.join(unused)}; it has: {known}") from None
        if unknown := _unreferenced(text):
            raise InputError(f"the scene's integrator or film has no key {', '.join(map(repr, unknown))}") from None
        raise InputError(f"cannot load {path}: {text}") from None


# ------------------------------------------------------------------------------------------------------------------
# Integrators


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
        unknown, refused = _unreferenced(text), re.findall(r": it has no key '(\w+)'; ", text)
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


def _unreferenced(text: str) -> list[str]:
    """The key names in Mitsuba's complaint about properties that no plugin asked for."""
    _, found, listed = text.partition("unreferenced propert")
    return re.findall(r'- [\w ]+ "([\w.]+)":', listed) if found else []


def one_line(error: BaseException) -> str:
    """An exception's message on one line, without source positions and without the traceback of a Python plugin."""
    text = re.sub(r"\[\w+\.cpp:\d+\]\s*", "", str(error))
    text = re.sub(r"Traceback \(most recent call last\):.*\n\w*(Exception|Error): ", "", text, flags=re.DOTALL)
    return re.sub(r"\s+", " ", text).strip() or type(error).__name__


# ------------------------------------------------------------------------------------------------------------------
# Images out of Mitsuba


def split_channels(image: np.ndarray, aov_names: list[str]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A developed film as RGB of shape (height, width, 3) and its further channels by name, float64.

    A film with one channel is repeated to three, an alpha channel goes by the name `A`.
    """
    image = np.asarray(image, np.float64)
    if [name.rpartition(".")[2] for name in aov_names[:4]] == list("RGBA"):
        aov_names = aov_names[4:]  # Mitsuba's `aov` lists the image of the integrator nested in it, which is the film's
    n_base = image.shape[2] - len(aov_names)
    if n_base == 0:
        raise InputError("this integrator gives no colour image; nest one in it, as in --set image.type=path")
    if n_base not in (1, 2, 3, 4):
        raise InputError(f"the film has {n_base} colour channels: use <film type='hdrfilm'> with pixel_format rgb")
    n_colour = 1 if n_base < 3 else 3
    rgb = np.repeat(image[..., :1], 3, axis=-1) if n_colour == 1 else image[..., :3]
    names = (["A"] if n_base > n_colour else []) + list(aov_names)
    return rgb, {name: image[..., n_colour + k] for k, name in enumerate(names)}
