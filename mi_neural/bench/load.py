"""From what a user typed to a scene of Mitsuba, with another film size, and from its film to RGB and further channels.

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


class InputError(ValueError):
    """What the user typed cannot be done; the message is one line and complete."""


def user_path(path: str | Path) -> Path:
    """A path as a user typed it: `~` at its start is the user's home, `~name` that of a user of this name, if any."""
    return Path(os.path.expanduser(path))


def unreferenced(text: str) -> list[str]:
    """The key names in Mitsuba's complaint about properties that no plugin asked for."""
    _, found, listed = text.partition("unreferenced propert")
    return re.findall(r'- [\w ]+ "([\w.]+)":', listed) if found else []


def one_line(error: BaseException) -> str:
    """An exception's message on one line, without source positions and without the traceback of a Python plugin."""
    text = re.sub(r"\[\w+\.cpp:\d+\]\s*", "", str(error))
    text = re.sub(r"Traceback \(most recent call last\):.*\n\w*(Exception|Error): ", "", text, flags=re.DOTALL)
    return re.sub(r"\s+", " ", text).strip() or type(error).__name__


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
        if unknown := unreferenced(text):
            raise InputError(f"the scene's integrator or film has no key {', '.join(map(repr, unknown))}") from None
        raise InputError(f"cannot load {path}: {text}") from None


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
