"""Parameters of scene objects as they can be read, whatever plugin they belong to.

``mi.traverse(node)[key]`` raises where a value is None (``sigma_a`` of ``hair``) or of a type that Mitsuba cannot hand
over, and a plugin of the user's own may fail in its ``traverse``. Here such values are left out.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def traverse(node):
    """``mi.traverse(node)`` without entries that have no value; without any where the object's own traversal fails."""
    try:
        params = mi.traverse(node)
    except Exception:  # of whatever kind: it is the user's code
        return mi.SceneParameters()
    for key in [key for key in params.keys() if read(params, key) is None]:
        del params[key]
    return params


def read(params, key: str):
    """A parameter's value now, None where it has none or where it cannot be handed over. Unlike ``params[key]``, no
    edit of the value in place is looked for later."""
    value, kind, node, _ = params.properties[key]
    try:
        return value if kind is None else mi.get_property(value, kind, node)
    except Exception:
        return None


class Edits:
    """Says when a value of any of these parameters, pairs of (``mi.traverse(node)``, key), has become another.

    An array is the same as long as its variables have the same numbers. A copy keeps them alive, so that their numbers
    are given to no other. Everything is read in a few calls: 40,000 parameters of 10,000 lamps take 60 ms.
    """

    def __init__(self, pairs):
        self.pairs = list(pairs)
        self.kept = None

    def changed(self) -> bool:
        """Whether a value is another one than in the call before; the first time it is."""
        arrays, others = self._read()
        now = dr.detail.collect_indices(arrays), others
        if self.kept is not None and now == self.kept[0]:
            return False
        self.kept = now, [type(v)(v) for v in arrays]
        return True

    def forget(self) -> None:
        """Let the next call of :meth:`changed` be as the first one."""
        self.kept = None

    def _read(self) -> tuple[list, list]:
        """Values now: arrays, and others as what can be compared."""
        arrays, others = [], []
        for params, key in self.pairs:
            v = read(params, key)
            if hasattr(type(v), "inverse_transpose"):  # a transformation
                v = v.matrix
            if v is not None and dr.is_jit_v(v):
                arrays.append(v)
            else:
                others.append(v.tobytes() if hasattr(v, "tobytes") else text(v))
        return arrays, others


def text(node) -> str:
    """``str(node)``; empty where a class of the user's own has none that works."""
    try:
        return str(node)
    except Exception:
        return ""
