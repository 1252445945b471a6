"""Dynamic scenes: parameters that change from frame to frame, and the error of each frame.

:class:`Sequence` sets a scene to the state of a frame; :class:`References` holds one reference for each state;
:class:`Run` renders the frames of one integrator after another, measures them, and goes on where it was interrupted.

A frame is what ``mi.render`` makes of the state at that frame: an integrator with a cache trains its `train_steps`
first, and carries over what it knows from the frames before. Kernels are compiled before the first frame.

Per frame: seconds (training and rendering), HDR-FLIP, relMSE, and SMAPE to the frame before. FLIP's exposures are the
same for all frames: from the lowest start to the highest stop that FLIP chooses for any of the references. SMAPE at a
change contains the change itself; `smape_reference`, that of the references, says how much that is.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import ceil
from pathlib import Path

import numpy as np

from mi_neural.image import exr, metrics

from . import benchmark, budget, changes, denoise
from . import reference as references
from .benchmark import Case, plain
from .budget import clock
from .load import InputError, LoadedScene

#: Stream of random numbers of the frames; those below it belong to :mod:`budget`.
STREAM_FRAMES = 16
#: Training frames between two checks whether to save.
PRETRAIN_PART = 64
#: Share of the time that saving a cache may take.
KEEP_SHARE = 0.05

# ------------------------------------------------------------------------------------------------------------------
# The scene over time


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


# ------------------------------------------------------------------------------------------------------------------
# Rendering it


@dataclass(frozen=True)
class Plan:
    """How each integrator renders the sequence. `pretrain` counts training frames in the state of frame 0."""

    spp: int = 1
    pretrain: int = 0
    seed: int = 0
    denoise: bool = False


@dataclass
class Frame:
    """One frame as rendered, the seconds that it took to change the scene, and what it was rendered with."""

    rendered: budget.Rendered
    seconds_update: float
    environment: dict[str, object]


@dataclass
class Result:
    """One integrator over the sequence: its folder, and a row (a dictionary) for each frame that is done."""

    label: str
    folder: Path
    rows: list[dict[str, object]] = field(default_factory=list)
    facts: dict[str, object] = field(default_factory=dict)

    def image(self, frame: int) -> exr.Image:
        """A frame that is done."""
        return exr.read(frame_path(self.folder, frame))


def frame_path(folder: Path, frame: int) -> Path:
    """The file of a frame."""
    return folder / f"frame_{frame:04d}.exr"


class Run:
    """Renders a sequence with one integrator after another into a folder for each, below `folder`:

    frame_0000.exr   a frame: image, further channels of the integrator, facts as metadata
    frames.jsonl     a line for each frame: frame, state, seconds, flip, smape, relmse, relmse_trimmed, mean, statistics
    sequence.json    what the frames were rendered with, and what the preparation cost
    cache_0012.npz   what the integrator had learned after 12 frames, where it can say (`save_cache`)

    Started again with the same settings, a case goes on after its last frame: frames since the last cache file are
    rendered anew. A cache file holds all that training changes, but not what a light sampler learned: with one, images
    after it are not those of an uninterrupted run to the last digit. Integrators without `save_cache`
    simply go on. ``KeyboardInterrupt`` passes through; `results` then holds what is done.

    `elsewhere`, called with (case, range of frames), yields them in order as another place renders them. What the
    integrator learns, it then learns here and before the first of them.
    """

    def __init__(
        self,
        loaded: LoadedScene,
        sequence: Sequence,
        plan: Plan,
        folder: Path,
        reference_spp: int | None = None,
        environment: dict[str, object] | None = None,
        progress: Callable[[str], budget.Progress | None] | None = None,
        elsewhere: Callable[[Case, range], Iterator[Frame]] | None = None,
    ) -> None:
        self.loaded, self.sequence, self.plan, self.folder = loaded, sequence, plan, folder
        self.elsewhere = elsewhere
        self.references = None
        if reference_spp:
            self.references = References(loaded, sequence, reference_spp, folder / "references")
        self.environment = environment or {}
        self.progress = progress or (lambda text: None)
        self.results: list[Result] = []
        self._guides: tuple[str, denoise.Guides] | None = None

    def check(self, cases: list[Case]) -> None:
        """Raise :class:`InputError` where a case's folder holds frames of other settings, or two share a folder."""
        folders: dict[Path, str] = {}
        for case in cases:
            folder = self.case_folder(case)
            if folder in folders:
                raise InputError(f"-i {folders[folder]} and -i {case.spec.label} would share the folder {folder.name}")
            folders[folder] = case.spec.label
            self._check_settings(folder, self._settings(case))
            self._done(folder)

    def run(self, cases: list[Case]) -> list[Result]:
        """References, then all cases; the scene is in its original state afterwards."""
        self.check(cases)
        try:
            if self.references is not None:
                self.references.render(self.progress)
            for case in cases:
                self.run_case(case)
        finally:
            self.sequence.restore()
        return self.results

    def case_folder(self, case: Case) -> Path:
        """Where a case's frames go."""
        return self.folder / re.sub(r"[^\w.-]+", "_", case.spec.label.replace("=", "-"))

    # ----------------------------------------------------------------------------------------------------------------

    def run_case(self, case: Case) -> Result:
        """All frames of one integrator that are not done yet."""
        folder, scene, integrator = self.case_folder(case), self.loaded.scene, case.integrator
        folder.mkdir(parents=True, exist_ok=True)
        settings, exposures = self._settings(case), self.references and self.references.exposures
        if exposures:
            settings["flip_exposures"] = plain([exposures.start, exposures.stop, exposures.num])
        self._check_settings(folder, settings)
        result = Result(case.spec.label, folder, self._done(folder), self._facts(folder))
        self.results.append(result)
        if len(result.rows) >= self.sequence.frames:
            return result

        # ---- In the state of frame 0, so that a cache file is met by the scene that it was begun in
        self.sequence.apply(0)
        if self.elsewhere is None:
            self.progress(f"{case.spec.label}: compiling")
            sizes = sorted(set(budget.plan_passes(scene, self.plan.spp)))
            case.seconds_compile = budget.warm_up(scene, integrator, sizes, self.plan.seed)
        elif hasattr(integrator, "train"):
            integrator.train(scene, 0)  # binds it to the scene, as compiling does
        keeper = _Keeper(integrator, folder)
        done = keeper.load(len(result.rows))
        del result.rows[0 if done is None else done :]
        result.facts["seconds_compile"] = case.seconds_compile
        self._write_settings(folder, settings, result.facts)
        _write_rows(folder, result.rows)
        if done is None:
            budget.reset(integrator)
            result.facts.update(pretrained=0, seconds_pretrain=0.0)
        if not result.rows:
            self._pretrain(case, keeper, result, settings)
        if self.elsewhere is not None and not result.rows:
            bar = self.progress(f"{case.spec.label}: training")
            seconds, interrupted = budget.train_first(scene, integrator, progress=bar)
            if interrupted:
                raise KeyboardInterrupt
            result.facts["seconds_pretrain"] += seconds
            keeper.save(0)
            self._write_settings(folder, settings, result.facts)

        # ---- Frames
        start = len(result.rows)
        bar = self.progress(f"{case.spec.label}: frames")
        previous = result.image(start - 1).rgb if start else None
        todo = range(start, self.sequence.frames)
        for frame, found in zip(todo, (self.elsewhere or self._frames)(case, todo), strict=True):
            row, previous = self._measure(case, folder, frame, found, previous)
            result.rows.append(row)
            with open(folder / "frames.jsonl", "a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            if keeper.due() or frame + 1 == self.sequence.frames:
                keeper.save(frame + 1)
            if bar:
                bar(frame + 1, self.sequence.frames)
        return result

    def _pretrain(self, case: Case, keeper: _Keeper, result: Result, settings: dict[str, object]) -> None:
        """Train before the first frame, in parts that an interruption leaves done."""
        facts, total = result.facts, self.plan.pretrain
        if not hasattr(case.integrator, "train") or facts["pretrained"] >= total:
            return
        bar = self.progress(f"{case.spec.label}: training {total} frames")
        while (trained := facts["pretrained"]) < total:
            n = min(PRETRAIN_PART, total - trained)
            part = bar and (lambda done, _, trained=trained: bar(trained + done, total))
            seconds, interrupted = budget.train(self.loaded.scene, case.integrator, n, progress=part)
            if interrupted:
                raise KeyboardInterrupt
            facts.update(pretrained=trained + n, seconds_pretrain=facts["seconds_pretrain"] + seconds)
            if keeper.due() or facts["pretrained"] == total:
                keeper.save(0)
                self._write_settings(result.folder, settings, facts)

    def _frames(self, case: Case, frames: range) -> Iterator[Frame]:
        """Frames rendered by this process, each when it is asked for."""
        scene, plan = self.loaded.scene, self.plan
        for frame in frames:
            start = clock()
            self.sequence.apply(frame)
            seconds_update = clock() - start
            seed = budget.pass_seed(plan.seed, STREAM_FRAMES, frame)
            rendered = budget.render_samples(scene, case.integrator, plan.spp, seed)
            if rendered.interrupted:
                raise KeyboardInterrupt
            yield Frame(rendered, seconds_update, self.environment)

    def _measure(self, case: Case, folder: Path, frame: int, found: Frame, previous: np.ndarray | None):
        """Measure and write one frame; returns (row, image)."""
        plan, rendered = self.plan, found.rendered
        image, seconds_denoise = rendered.rgb, 0.0
        if plan.denoise:
            image, seconds_denoise = denoise.denoise(rendered.rgb, self._guides_of(frame))

        full = benchmark.make_row(
            self.loaded,
            case,
            "sequence",
            [rendered],
            [image],
            plan.seed,
            denoised=plan.denoise,
            seconds_denoise=seconds_denoise,
            environment=found.environment,
            pretrain_frames=plan.pretrain,
        )
        row = {
            "frame": frame,
            "state": self.sequence.states[frame],
            "seconds": full.seconds_total,
            "seconds_train": full.seconds_train,
            "seconds_render": full.seconds_render,
            "seconds_denoise": seconds_denoise,
            "seconds_update": found.seconds_update,
            "spp": full.spp,
            "mean": full.mean,
            "nonfinite": full.nonfinite,
            "flip": None,
            "smape": metrics.smape(image, previous) if previous is not None else None,
            "smape_reference": None,
            "relmse": None,
            "relmse_trimmed": None,
            "statistics": {k: v for k, v in rendered.statistics.items() if isinstance(v, (bool, int, float))},
        }
        if self.references is not None:
            if frame:
                before = self.references.of(frame - 1).rgb
                row["smape_reference"] = metrics.smape(self.references.of(frame).rgb, before)
            reference = self.references.of(frame)
            errors, _ = metrics.errors(image, reference.rgb, reference.variance, self.references.exposures)
            row.update(flip=errors.flip, relmse=errors.relmse, relmse_trimmed=errors.relmse_trimmed)
            full.flip, full.relmse, full.relmse_trimmed = errors.flip, errors.relmse, errors.relmse_trimmed
        full.flicker, full.image = row["smape"], frame_path(folder, frame).name
        channels = dict(rendered.channels)
        if plan.denoise:
            channels.update(exr.layer_channels("noisy", rendered.rgb))
        facts = {**full.to_json(), "frame": frame, "state": row["state"]}
        exr.write(frame_path(folder, frame), image, channels, {k: v for k, v in facts.items() if v not in ({}, "")})
        return plain(row), image

    def _guides_of(self, frame: int) -> denoise.Guides:
        """The denoiser's guides for the state of a frame; their time counts for no integrator."""
        state = self.sequence.states[frame]
        if self._guides is None or self._guides[0] != state:
            first = self._guides is None
            self.sequence.apply(frame)
            self._guides = state, denoise.render_guides(self.loaded.scene, self.plan.seed)[0]
            if first:
                denoise.warm_up(self._guides[1])
        return self._guides[1]

    # ----------------------------------------------------------------------------------------------------------------
    # What is on disk

    def _settings(self, case: Case) -> dict[str, object]:
        """All that two runs must have in common for their frames to be of one sequence; the states are in the rows."""
        import mitsuba as mi

        loaded, plan = self.loaded, self.plan
        settings = {
            "scene": loaded.name,
            "scene_file": loaded.digest[:16],
            "parameters": loaded.parameters,
            "size": loaded.size,
            "integrator": case.spec.type,
            "keys": case.keys,
            "spp": plan.spp,
            "pretrain": plan.pretrain,
            "seed": plan.seed,
            "denoise": plan.denoise,
            "variant": mi.variant(),
            "reference_spp": self.references and self.references.spp,
        }
        return json.loads(json.dumps(plain(settings)))

    def _check_settings(self, folder: Path, settings: dict[str, object]) -> None:
        kept = _read_json(folder / "sequence.json").get("settings")
        for name in settings if kept is not None else ():
            if name in kept and kept[name] != settings[name]:
                raise InputError(
                    f"{folder} holds frames of another run ({name}: {kept[name]} there, {settings[name]} now): "
                    "choose another folder with -o, or delete that one"
                )

    def _facts(self, folder: Path) -> dict[str, object]:
        return dict(_read_json(folder / "sequence.json").get("facts") or {})

    def _write_settings(self, folder: Path, settings: dict[str, object], facts: dict[str, object]) -> None:
        exr.write_text(folder / "sequence.json", json.dumps({"settings": settings, "facts": facts}, indent=1) + "\n")

    def _done(self, folder: Path) -> list[dict[str, object]]:
        """Rows of the frames that are complete: those before the first line or image that is missing or broken."""
        rows: list[dict[str, object]] = []
        path = folder / "frames.jsonl"
        for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
            try:
                row = json.loads(line)
                frame, state = row["frame"], row["state"]
            except (ValueError, KeyError, TypeError):
                break  # the end of an interrupted write
            if frame != len(rows) or frame >= self.sequence.frames or not frame_path(folder, frame).is_file():
                break
            if state != self.sequence.states[frame]:
                raise InputError(
                    f"{folder} holds frames of another sequence (frame {frame} has other values of the changed "
                    "parameters): choose another folder with -o, or delete that one"
                )
            rows.append(row)
        return rows


class _Keeper:
    """Cache files of one case: `cache_0012.npz` is the state after 12 frames. Saves as often as it costs little."""

    def __init__(self, integrator, folder: Path) -> None:
        self.integrator, self.folder = integrator, folder
        self.able = hasattr(integrator, "save_cache") and hasattr(integrator, "load_cache")
        self.cost, self.saved = 0.0, clock()
        if self.able:
            try:
                with exr.replacing(folder / "cache_probe.npz") as probe:
                    integrator.save_cache(str(probe))
                (folder / "cache_probe.npz").unlink()
            except RuntimeError:  # settings with which no cache is ever queried
                self.able = False
            self.cost, self.saved = clock() - self.saved, clock()

    def load(self, n_done: int) -> int | None:
        """Bring back the latest state that is not after `n_done` frames; returns after how many. None: begin anew."""
        if not self.able:
            return n_done or None
        counts = [n for n in self._counts() if n <= n_done]
        if not counts:
            return None
        self.integrator.load_cache(str(self._path(max(counts))))
        return max(counts)

    def due(self) -> bool:
        """Whether saving now keeps its share of the time."""
        return self.able and KEEP_SHARE * (clock() - self.saved) >= self.cost

    def save(self, n_done: int) -> None:
        """Keep the state after `n_done` frames, and no other."""
        if not self.able:
            return
        start = clock()
        self.integrator.save_cache(str(self._path(n_done)))
        for n in self._counts():
            if n != n_done:
                self._path(n).unlink()
        self.saved = clock()
        self.cost = self.saved - start

    def _path(self, n: int) -> Path:
        return self.folder / f"cache_{n:04d}.npz"

    def _counts(self) -> list[int]:
        matches = (re.fullmatch(r"cache_(\d+)\.npz", p.name) for p in self.folder.iterdir())
        return [int(m[1]) for m in matches if m]


def _write_rows(folder: Path, rows: list[dict[str, object]]) -> None:
    exr.write_text(folder / "frames.jsonl", "".join(json.dumps(row) + "\n" for row in rows))


def _read_json(path: Path) -> dict[str, object]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
