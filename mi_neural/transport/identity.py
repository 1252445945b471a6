"""Telling one scene from another."""

from __future__ import annotations


class SceneWatch:
    """Remembers a scene by its shapes and emitters.

    It holds the parts, so that no other scene's can lie where they lay; not the scene, which may hold whoever watches.
    """

    def __init__(self):
        self.parts: tuple | None = None

    def changed(self, scene) -> bool:
        """Whether `scene` is another one than in the call before; the first time it is."""
        parts = (*scene.shapes(), *scene.emitters())
        known = self.parts
        if known is not None and len(known) == len(parts) and all(a is b for a, b in zip(known, parts, strict=True)):
            return False
        self.parts = parts
        return True
