"""Telling one scene from another."""

from __future__ import annotations


class BoundScene:
    """Remembers a scene by its shapes and emitters.

    It holds the parts, so that no other scene's can lie where they lay; not the scene, which may hold whoever watches.
    """

    def __init__(self):
        self.parts: tuple | None = None

    def knows(self, scene) -> bool:
        """Whether `scene` is the one that was last looked at."""
        parts = _parts(scene)
        known = self.parts
        return known is not None and len(known) == len(parts) and all(a is b for a, b in zip(known, parts, strict=True))

    def changed(self, scene) -> bool:
        """Whether `scene` is another one than in the call before; the first time it is."""
        if self.knows(scene):
            return False
        self.parts = _parts(scene)
        return True


def _parts(scene) -> tuple:
    return (*scene.shapes(), *scene.emitters())
