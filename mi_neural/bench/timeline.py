"""The scene of a sequence over time: its state at each frame, and one reference for each state."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil
from pathlib import Path

import numpy as np

from mi_neural.image import metrics

from . import budget, changes
from . import reference as references
from .load import InputError, LoadedScene


class Sequence:
    """A scene whose parameters are functions of the frame.

    functions  key -> function(frame, original value) -> new value of the same shape; see :mod:`changes` for keys and
               shapes. A function must give the same for the same frame every time
    frames     their number
    change_at  frame of an abrupt change, before and after which figures are separate; default: the first frame unlike
               frame 0

    All functions are called for all frames here, so that what is wrong is found before the first image: raises
    :class:`InputError` for an unknown key, a function that fails or gives NaN or another shape (and says at which
    frame), two changes of one parameter, no frames, a change after the end.

    ``states[frame]`` is a hash of all values that are not the original ones, "" where none is.
    """

    def __init__(
        self, scene, functions: dict[str, changes.Function], frames: int, change_at: int | None = None
    ) -> None:
        import mitsuba as mi

        check_frames(frames, change_at)
        self.frames, self.change_at = int(frames), change_at
        self._params = mi.traverse(scene)
        known = changes.keys(self._params)
        self.parameters: list[changes.Parameter] = []
        self._functions: list[changes.Function] = []
        for key, function in functions.items():
            self.parameters.append(known[changes.find_key(known, key)]())
            self._functions.append(function)
        self._check_distinct()

        n = len(self.parameters)
        originals = [changes.digest({p.key: p.value}) for p in self.parameters]
        self._digests = [[""] * n for _ in range(self.frames)]  # "" stands for the original value
        self.states = []
        for frame in range(self.frames):
            values = {}
            for k, parameter in enumerate(self.parameters):
                value = self._value(k, frame)
                found = changes.digest({parameter.key: value})
                if found != originals[k]:
                    self._digests[frame][k] = found
                    values[parameter.key] = value
            self.states.append(changes.digest(values))

        self._current = ["unset"] * n  # so that all are set once, and later frames run the same kernels as frame 0
        self.restore()

    @property
    def change(self) -> int | None:
        """The frame that divides before from after: `change_at`, or the first frame unlike frame 0; None where there is
        none."""
        if self.change_at is not None:
            return self.change_at
        return next((k for k, state in enumerate(self.states) if state != self.states[0]), None)

    def apply(self, frame: int) -> bool:
        """Set the scene to the state of `frame`; returns whether anything had to be set."""
        if not 0 <= frame < self.frames:
            raise InputError(f"there is no frame {frame}: the sequence has frames 0 to {self.frames - 1}")
        return self._set(self._digests[frame], lambda k: self._value(k, frame))

    def restore(self) -> bool:
        """Set all parameters to what they were; returns whether anything had to be set."""
        return self._set([""] * len(self.parameters), lambda k: self.parameters[k].value)

    def _set(self, digests: list[str], value: Callable[[int], np.ndarray]) -> bool:
        stale = [k for k, digest in enumerate(digests) if digest != self._current[k]]
        for k in stale:
            self.parameters[k].set(self.parameters[k].value if not digests[k] else value(k))
            self._current[k] = digests[k]
        if stale:
            self._params.update()  # rebuilds acceleration structures and emitter distributions
        return bool(stale)

    def _value(self, k: int, frame: int) -> np.ndarray:
        parameter = self.parameters[k]
        try:
            return parameter.check(self._functions[k](frame, parameter.value.copy()))
        except Exception as error:
            text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            raise InputError(f"the change of {parameter.key} at frame {frame}: {text}") from None

    def _check_distinct(self) -> None:
        touched: dict[str, str] = {}
        for parameter in self.parameters:
            owner, _, name = parameter.key.rpartition(".")
            placement = name in ("to_world", "direction", "vertex_positions", "vertex_normals")
            target = f"{owner} placement" if placement else parameter.key
            if target in touched:
                both = " and ".join(dict.fromkeys((touched[target], parameter.key)))
                raise InputError(f"{both}: the same parameter is changed twice; give one change")
            touched[target] = parameter.key


def check_frames(frames: int, change_at: int | None) -> None:
    """Raise :class:`InputError` for no frames, or for a change outside of them."""
    if frames < 1:
        raise InputError(f"--frames takes a number of frames from 1, got {frames}")
    if change_at is not None and not 1 <= change_at < frames:
        where = "is after the end" if change_at >= frames else "is not after the first frame"
        raise InputError(f"--change-at {change_at} {where}: the frames are 0 to {frames - 1}, give 1 to {frames - 1}")


class References:
    """One reference for each state of a sequence, rendered once and kept in `folder`; see :mod:`reference`."""

    def __init__(self, loaded: LoadedScene, sequence: Sequence, spp: int, folder: Path) -> None:
        self.loaded, self.sequence, self.spp, self.folder = loaded, sequence, spp, folder
        self.first = {state: frame for frame, state in reversed(list(enumerate(sequence.states)))}
        self.exposures: metrics.FlipExposures | None = None
        self._held: dict[str, references.Reference] = {}

    def render(self, progress: Callable[[str], budget.Progress | None]) -> None:
        """Render what is missing and choose FLIP's exposures; goes on with what an interruption left."""
        self.folder.mkdir(parents=True, exist_ok=True)
        found = []
        for k, (state, frame) in enumerate(sorted(self.first.items(), key=lambda item: item[1])):
            bar = progress(f"reference {k + 1} of {len(self.first)}, {self.spp} samples a pixel")
            self.sequence.apply(frame)
            made = references.render_reference(self.loaded, self.spp, self.folder, bar, state=state)
            if made.rgb.max() > 0.0:
                found.append(metrics.flip_exposures(made.rgb))
        if found:
            start, stop = min(e.start for e in found), max(e.stop for e in found)
            self.exposures = metrics.FlipExposures(start, stop, max(2, ceil(stop - start)))
        else:
            self.exposures = metrics.FlipExposures(0.0, 0.0, 1)

    def of(self, frame: int) -> references.Reference:
        """The reference of a frame; the last two that were asked for are kept in memory."""
        state = self.sequence.states[frame]
        if state not in self._held:
            path = references.reference_path(self.loaded, self.folder, state)
            self._held = dict(list(self._held.items())[-1:])
            self._held[state] = references.load_reference(path, self.loaded.size)
        return self._held[state]
