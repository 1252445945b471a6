"""Speed against error: several integrators, equal time, one reference.

Kinds of rows, each raw and, with ``--denoise``, also denoised:

one-shot   a cache starts empty; S seconds, counted from when kernels are compiled, training included. The denoiser's
           time is reported separately and is not part of S.
steady     a cache has been trained for a number of frames before the clock starts; then frames of equal total time. For
           a denoised frame the denoiser's time is part of it, so that fewer samples are taken.
sample     frames of one sample a pixel, in the same steady state: median time and mean error.
split      where the time of such a frame goes (:mod:`.split`).
curve      the image of the longest one-shot run after 1, 2, 4, ... samples a pixel, as it stood then: relMSE alone,
           since FLIP takes longer to compute than many samples take to render.

All of it is repeated with seeds that share nothing, for the training as well, so that the rows of one kind are
independent. The peak of memory is that of the process since its integrator was compiled.

Errors of steady and sample rows are means over their frames; flicker is the mean SMAPE between consecutive frames of a
still scene, whose exact value is 0. Every integrator gets the scene's own depth, the same film, the same guides for the
denoiser, and seeds of its own for every pass. The time for rendering the guides belongs to no integrator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from statistics import median

import numpy as np

from mi_neural.image import metrics

from . import budget, denoise, memory, split
from .budget import Rendered
from .judging import averaged, judge, mean_relmse
from .load import LoadedScene
from .reference import Reference
from .specs import IntegratorSpec, build_integrator, format_value

#: Frames that a steady row averages over, and those of a sample row.
STEADY_FRAMES = 4
SAMPLE_FRAMES = 5
#: Kinds of rows without a picture.
WITHOUT_PICTURE = ("curve", "split")
#: Distance between the seeds of two repeats; the frames of a repeat use the seeds that follow its own.
SEED_STEP = 10_000


@dataclass
class Row:
    """One line of a table: what was rendered, its time and its error. Times in seconds, of one frame.

    `None` means not measured or not applicable: errors without a reference, `flicker` of a single image, cache counts
    of an integrator without a cache, `split` (a :class:`.split.Split`) of rows of another kind, `spp` of an image made
    elsewhere (:mod:`.elsewhere`). `seconds_to_first_image` counts from the start of the process, compiling included.
    `flip` is measured against the reference, `flip_clean` against the denoised reference.
    """

    scene: str
    integrator: str
    label: str
    parameters: dict[str, object]
    size: list[int]
    seed: int
    mode: str
    frames: int
    denoised: bool
    spp: float | None
    seconds_compile: float
    seconds_train: float
    seconds_render: float
    seconds_denoise: float
    seconds_total: float
    ns_per_sample: float | None
    ns_per_query: float | None
    records: int | None
    queries: int | None
    mean: float
    nonfinite: int
    budget_seconds: float | None = None
    pretrain_frames: int = 0
    seconds_pretrain: float = 0.0
    relmse: float | None = None
    relmse_trimmed: float | None = None
    flip: float | None = None
    flip_clean: float | None = None
    flicker: float | None = None
    repeat: int = 0
    peak_mib: float | None = None
    split: dict[str, float | None] | None = None
    interrupted: bool = False
    image: str | None = None
    seconds_to_first_image: float | None = None
    statistics: dict[str, object] = field(default_factory=dict)
    environment: dict[str, object] = field(default_factory=dict)

    @property
    def made_elsewhere(self) -> bool:
        """Whether another renderer made the image."""
        return "made_elsewhere" in self.statistics

    def to_json(self) -> dict[str, object]:
        """The row as a dictionary of plain values."""
        return plain(asdict(self))


@dataclass
class Picture:
    """An image that belongs to a row, with the FLIP map against the reference where there is one.

    `rendered` is None for one that an earlier run has measured, `rgb` for rows WITHOUT_PICTURE.
    """

    row: Row
    rendered: Rendered | None
    rgb: np.ndarray | None
    flip_map: np.ndarray | None


@dataclass
class Case:
    """One integrator to be measured: its spec, the object, the keys it was given and the cost of compiling it."""

    spec: IntegratorSpec
    integrator: object
    keys: dict[str, object]
    seconds_compile: float = 0.0


@dataclass
class Plan:
    """What to measure. `frame_seconds` and the sample row need `steady_frames` > 0."""

    seconds: list[float]
    steady_frames: int = 0
    frame_seconds: list[float] = field(default_factory=list)
    seed: int = 0
    repeats: int = 1


class Bench:
    """Measures integrators on one scene against one reference; hand each finished picture to `on_picture`.

    After Ctrl-C the current rendering is finished early, its row is marked, and ``KeyboardInterrupt`` is raised after
    it. What `kept` holds (a :class:`~mi_neural.bench.kept.Kept`) is not measured again.
    """

    def __init__(
        self,
        loaded: LoadedScene,
        reference: Reference | None,
        guides: denoise.Guides | None,
        environment: dict[str, object],
        on_picture: Callable[[Picture], None],
        progress: Callable[[str], budget.Progress | None] | None = None,
        kept=None,
    ) -> None:
        self.loaded, self.reference, self.guides, self.kept = loaded, reference, guides, kept
        self.environment, self.on_picture = environment, on_picture
        self._progress = progress or (lambda text: None)
        self.exposures = metrics.flip_exposures(reference.rgb) if reference else None
        self.denoise_seconds = denoise.warm_up(guides) if guides else 0.0
        self.counts_memory = False

    def run(self, cases: list[Case], plan: Plan) -> None:
        """Measure all cases: one-shot by budgets, then steady and sample rows, and the whole again for each repeat."""
        for case in cases:
            compiled = False
            for keys, measure in self._parts(case, plan):
                if self.kept is not None and (found := self.kept.pictures(keys, self.reference, self.exposures)):
                    for picture in found:
                        self.on_picture(picture)
                    continue
                if not compiled:
                    self.compile(case, plan.seed)
                    compiled = True
                measure()
            case.integrator = None  # its memory must not count as the next one's

    def recall(self, case: Case, plan: Plan) -> bool:
        """Hand over all rows of a case if none is left to be measured; returns whether that is so."""
        found = []
        for keys, _ in self._parts(case, plan):
            pictures = self.kept.pictures(keys, self.reference, self.exposures)
            if not pictures:
                return False
            found += pictures
        for picture in found:
            self.on_picture(picture)
        return True

    def _parts(self, case: Case, plan: Plan) -> list[tuple[list[tuple], Callable[[], None]]]:
        """What is measured of a case, in pieces: the keys of the rows that a piece gives, and the call that does it."""
        label, kinds = case.spec.label, [False, True] if self.guides else [False]
        parts = []
        for repeat in range(plan.repeats):
            for seconds in plan.seconds:
                keys = [(label, "one-shot", seconds, d, repeat) for d in kinds]
                parts.append((keys, partial(self.one_shot, case, seconds, plan, repeat)))
            if plan.steady_frames:
                keys = [(label, "sample", None, d, repeat) for d in kinds]
                keys += [(label, "steady", s, d, repeat) for s in plan.frame_seconds for d in kinds]
                keys.append((label, "split", None, False, repeat))
                parts.append((keys, partial(self.steady, case, plan, repeat)))
        return parts

    # ----------------------------------------------------------------------------------------------------------------

    def compile(self, case: Case, seed: int) -> None:
        """Compile the kernels of all pass sizes. The peak of memory counts from here on."""
        self._progress(f"{case.spec.label}: compiling")
        self.counts_memory = memory.start()
        scene = self.loaded.scene
        case.seconds_compile = budget.warm_up(scene, case.integrator, budget.pass_sizes(scene), seed)

    def one_shot(self, case: Case, seconds: float, plan: Plan, repeat: int) -> None:
        """Render from an empty cache within `seconds`; for the longest budget, record the error after 1, 2, 4, ...
        samples too."""
        seed = self._begin(case, plan, repeat)
        progress = self._progress(f"{_name(case, plan, repeat)}: {seconds:g} s")
        stages: list[Rendered] = []
        rendered = budget.render_seconds(
            self.loaded.scene, case.integrator, seconds, seed, progress=progress,
            watch=stages.append if seconds == max(plan.seconds) else None,
        )  # fmt: skip
        facts = {"seed": seed, "repeat": repeat, "budget_seconds": seconds}
        if self.reference is not None and not rendered.interrupted:
            for stage in stages:
                self._rows(case, "curve", [stage], **facts)
        self._rows(case, "one-shot", [rendered], **facts)

    def steady(self, case: Case, plan: Plan, repeat: int) -> None:
        """Frames of a cache that has been trained before the clock starts."""
        scene, integrator = self.loaded.scene, case.integrator
        seed, name = self._begin(case, plan, repeat), _name(case, plan, repeat)
        facts: dict[str, object] = {"seed": seed, "repeat": repeat}
        if hasattr(integrator, "train"):
            progress = self._progress(f"{name}: training {plan.steady_frames} frames")
            pretrain, interrupted = budget.train(scene, integrator, plan.steady_frames, progress=progress)
            if interrupted:
                raise KeyboardInterrupt
            facts |= {"pretrain_frames": plan.steady_frames, "seconds_pretrain": pretrain}

        pass_times: dict[int, float] = {}
        # This frame is thrown away: what is made once per trained state must not count as the cost of a frame
        for size in budget.pass_sizes(scene):
            frame = budget.render_samples(scene, integrator, size, seed + 1000)
            if frame.interrupted:
                raise KeyboardInterrupt
            pass_times[size] = frame.seconds_render

        self._progress(f"{name}: 1-sample frames")
        samples = []
        for k in range(SAMPLE_FRAMES):
            samples.append(budget.render_samples(scene, integrator, 1, seed + k))
            if samples[-1].interrupted:
                break
        self._rows(case, "sample", samples, **facts)

        for seconds in plan.frame_seconds:
            for with_denoiser in (False, True) if self.guides else (False,):
                progress = self._progress(f"{name}: frames of {seconds:g} s")
                available = seconds - (self.denoise_seconds if with_denoiser else 0.0)
                frames = []
                for k in range(STEADY_FRAMES):
                    frame = budget.render_seconds(
                        scene, integrator, available, seed + k, pretrained=True, pass_times=pass_times
                    )
                    frames.append(frame)
                    if progress:
                        progress(k + 1, STEADY_FRAMES)
                    if frame.interrupted:
                        break
                self._rows(case, "steady", frames, budget_seconds=seconds, only_denoised=with_denoiser, **facts)
        parts = split.measure(scene, integrator).to_json()  # last, as it trains on
        self._rows(case, "split", samples, only_denoised=False, split=parts, **facts)

    def _begin(self, case: Case, plan: Plan, repeat: int) -> int:
        """Forget what was learned; returns the seed of this repeat, which training follows as well."""
        seed = plan.seed + SEED_STEP * repeat
        budget.reset(case.integrator, seed if repeat else None)  # the first one trains by the seed among its keys
        return seed

    # ----------------------------------------------------------------------------------------------------------------

    def _rows(self, case: Case, mode: str, frames: list[Rendered], only_denoised: bool | None = None, **facts) -> None:
        """Rows and pictures for frames of one kind: raw and denoised, or only one of the two."""
        variants = [False, True] if self.guides else [False]
        for denoised in variants if only_denoised is None else [only_denoised]:
            images, seconds_denoise = [f.rgb for f in frames], 0.0
            if denoised:
                cleaned = [denoise.denoise(f.rgb, self.guides) for f in frames]
                images = [image for image, _ in cleaned]
                seconds_denoise = median(seconds for _, seconds in cleaned)
            row = make_row(
                self.loaded,
                case,
                mode,
                frames,
                images,
                denoised=denoised,
                seconds_denoise=seconds_denoise,
                environment=self.environment,
                **facts,
            )
            row.peak_mib = memory.peak_mib() if self.counts_memory else None
            flip_map = None
            if mode == "curve":
                row.relmse, row.relmse_trimmed = mean_relmse(averaged(images, self.reference), self.reference)
            elif mode != "split":
                flip_map = judge(row, images, self.reference, self.exposures)
            shown = (None, None, None) if mode in WITHOUT_PICTURE else (frames[0], images[0], flip_map)
            self.on_picture(Picture(row, *shown))
        if any(f.interrupted for f in frames):
            raise KeyboardInterrupt


def make_row(
    loaded: LoadedScene,
    case: Case,
    mode: str,
    frames: list[Rendered],
    images: list[np.ndarray],
    seed: int,
    *,
    denoised: bool,
    seconds_denoise: float,
    environment: dict[str, object],
    **further,
) -> Row:
    """A row without errors. Times are medians over the frames, counts are sums; `further` are fields as they are."""
    first, width_height = frames[-1].statistics, loaded.size
    spp = float(np.mean([f.spp for f in frames]))
    seconds_train = median(f.seconds_train for f in frames)
    seconds_render = median(f.seconds_render for f in frames)
    n_samples = width_height[0] * width_height[1] * np.array([f.spp for f in frames])
    finite = [image[np.isfinite(image).all(axis=-1)] for image in images]
    return Row(
        scene=loaded.name,
        integrator=case.spec.type,
        label=case.spec.label,
        parameters={**{f"${k}": v for k, v in loaded.parameters.items()}, **case.keys},
        size=list(width_height),
        seed=seed,
        mode=mode,
        frames=len(frames),
        denoised=denoised,
        spp=int(spp) if spp == int(spp) else spp,
        seconds_compile=case.seconds_compile,
        seconds_train=seconds_train,
        seconds_render=seconds_render,
        seconds_denoise=seconds_denoise,
        seconds_total=seconds_train + seconds_render + seconds_denoise,
        ns_per_sample=1e9 * float(np.median([f.seconds_render / n for f, n in zip(frames, n_samples, strict=True)])),
        ns_per_query=first.get("ns_per_query"),
        records=first.get("records"),
        queries=first.get("queries"),
        mean=float(np.mean([np.mean(f, dtype=np.float64) if f.size else 0.0 for f in finite])),
        nonfinite=int(sum(f.nonfinite for f in frames)) + int(first.get("nonfinite") or 0),
        interrupted=any(f.interrupted for f in frames),
        statistics=first,
        environment=environment,
        **further,
    )


def _name(case: Case, plan: Plan, repeat: int) -> str:
    return case.spec.label + (f", {repeat + 1} of {plan.repeats}" if plan.repeats > 1 else "")


def make_cases(
    loaded: LoadedScene, specs: list[IntegratorSpec], optional: dict[str, object] | None = None, denoise: bool = False
) -> list[Case]:
    """Build the integrators with the scene's own depth; with `denoise` for images that will be denoised, where they
    have settings of their own for that.

    `optional` keys go to every integrator that knows them; one that none knows is an error.
    """
    from .load import InputError

    cases, carried = [], {**loaded.carried, **({"denoised": True} if denoise else {})}
    for spec in specs:
        integrator, keys = build_integrator(spec, carried, optional)
        cases.append(Case(spec, integrator, keys))
    for key in optional or {}:
        if not any(key in case.keys for case in cases):
            raise InputError(f"none of {', '.join(c.spec.type for c in cases)} has a key {key!r}")
    return cases


def own_case(loaded: LoadedScene, keys: dict[str, object]) -> Case:
    """The scene's own integrator, on which `keys` were set when it was loaded; ``path`` where it names none."""
    spec = IntegratorSpec(loaded.integrator, keys)
    integrator = loaded.scene.integrator() or build_integrator(spec)[0]
    return Case(spec, integrator, {**loaded.carried, **keys})


def plain(value: object) -> object:
    """Replace what JSON cannot hold: NumPy scalars by Python's, non-finite floats by None, the unknown by its text."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else format_value(value)
