"""Scenes with known answers or known difficulty, found by name."""

from pathlib import Path

from . import public

__all__ = ["ANSWERS", "names", "path"]

_FOLDER = Path(__file__).resolve().parent


def names() -> list[str]:
    """The shipped scenes, in alphabetical order."""
    return sorted(file.stem for file in _FOLDER.glob("*.xml"))


def path(name: str) -> Path:
    """The XML file of a shipped scene, or of a public one that is on this machine (`mi-neural scenes`).

    Raises `ValueError` where there is none: it lists the names, or says what to type to get the scene.
    """
    if name in public.names():
        if not public.file(name).is_file():
            raise ValueError(f"the public scene {name!r} is not in {public.folder()}: type "
                             f"mi-neural scenes get {name.partition('/')[0]}")  # fmt: skip
        return public.file(name).resolve()
    if name not in names():
        raise ValueError(f"no scene named {name!r}; the shipped scenes are: {', '.join(names())}")
    return _FOLDER / f"{name}.xml"


def _point_lit_sphere(depth: int) -> float:
    """1/2 + 1/4 + ... from the first bounce on: 1 - 2^-(depth - 1)."""
    return 1.0 if depth < 0 else 1.0 - 2.0 ** -max(depth - 1, 0)


def _lit_cube(depth: int) -> float:
    """Emission 1/2, halved by every bounce: 1 - 2^-depth."""
    return 1.0 if depth < 0 else 1.0 - 2.0**-depth


# Radiance seen in every pixel and channel, as a function of `max_depth` (-1: no limit)
ANSWERS = {"lit_cube": _lit_cube, "point_lit_sphere": _point_lit_sphere}
