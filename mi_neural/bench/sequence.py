"""Dynamic scenes: parameters that change from frame to frame, and the error of each frame.

:class:`Sequence` sets a scene to the state of a frame; :class:`References` holds one reference for each state (both
:mod:`.timeline`); :class:`Run` renders the frames of one integrator after another, measures them, and goes on where it
was interrupted, from the files of :mod:`.sequence_files`.

A frame is what ``mi.render`` makes of the state at that frame: an integrator with a cache trains its `train_steps`
first, and keeps what it has learned from the frames before. Kernels are compiled before the first frame.

Per frame: seconds (training and rendering), HDR-FLIP, relMSE, and SMAPE to the frame before. FLIP's exposures are the
same for all frames: from the lowest start to the highest stop that FLIP chooses for any of the references. SMAPE at a
change contains the change itself; `smape_reference`, that of the references, says how much that is.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mi_neural.image import exr, metrics

from . import benchmark, budget, denoise
from .benchmark import Case, plain
from .budget import clock
from .load import InputError, LoadedScene
from .sequence_files import Keeper, frame_path, read_json, write_rows
from .specs import file_name, require_distinct
from .timeline import References, Sequence, check_frames

#: Stream of random numbers of the frames; those below it belong to :mod:`budget`.
STREAM_FRAMES = 16
#: Training frames between two checks whether to save.
PRETRAIN_PART = 64

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
        require_distinct([case.spec.label for case in cases], "the folder")
        for case in cases:
            folder = self.case_folder(case)
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
        return self.folder / file_name(case.spec.label)

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

        # ---- In the state of frame 0, so that a cache file is loaded with the scene in which it was begun
        self.sequence.apply(0)
        if self.elsewhere is None:
            self.progress(f"{case.spec.label}: compiling")
            sizes = sorted(set(budget.plan_passes(scene, self.plan.spp)))
            case.seconds_compile = budget.warm_up(scene, integrator, sizes, self.plan.seed)
        elif hasattr(integrator, "train"):
            integrator.train(scene, 0)  # binds it to the scene, as compiling does
        keeper = Keeper(integrator, folder)
        done = keeper.load(len(result.rows))
        del result.rows[0 if done is None else done :]
        result.facts["seconds_compile"] = case.seconds_compile
        self._write_settings(folder, settings, result.facts)
        write_rows(folder, result.rows)
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

    def _pretrain(self, case: Case, keeper: Keeper, result: Result, settings: dict[str, object]) -> None:
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

        import mi_neural

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
            "version": mi_neural.__version__,
            "reference_spp": self.references and self.references.spp,
        }
        return json.loads(json.dumps(plain(settings)))

    def _check_settings(self, folder: Path, settings: dict[str, object]) -> None:
        kept = read_json(folder / "sequence.json").get("settings")
        for name in settings if kept is not None else ():
            if name in kept and kept[name] != settings[name]:
                raise InputError(
                    f"{folder} holds frames of another run ({name}: {kept[name]} there, {settings[name]} now): "
                    "choose another folder with -o, or delete that one"
                )

    def _facts(self, folder: Path) -> dict[str, object]:
        return dict(read_json(folder / "sequence.json").get("facts") or {})

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


__all__ = [
    "Frame", "Plan", "References", "Result", "Run", "Sequence", "check_frames", "frame_path",
]  # fmt: skip
