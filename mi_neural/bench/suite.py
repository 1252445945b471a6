"""A comparison over several scenes: :mod:`.benchmark` on each, what is kept of each, and one report of all."""

from __future__ import annotations

import gc
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from mi_neural.image import exr

from . import (
    benchmark,
    collection,
    denoise,
    elsewhere,
    environment,
    jobs,
    kept,
    load,
    page,
    repeats,
    report,
    terminal,
)
from . import reference as references
from .load import InputError
from .specs import IntegratorSpec, require_distinct
from .workers import ClusterError, JobError, Workers

#: Samples a pixel of references that are rendered, where nothing else is asked for.
DEFAULT_REFERENCE_SPP = 1024


@dataclass
class Settings:
    """What is compared, on any scene.

    specs            integrators
    plan             budgets, frames, repeats
    keys             keys for every integrator that knows them
    parameters       values for `$parameters`; of several scenes, each takes those that it has
    sizes            sizes of films, see :func:`.load.load_scene`; None: the scenes' own
    reference        one image for all; None: the one beside the scene, unless `reference_spp` is given, or one rendered
    reference_spp    samples a pixel of rendered references
    reference_cache  folder in which these are kept
    denoise          have denoised rows, too
    images           images made by other renderers
    """

    specs: list[IntegratorSpec]
    plan: benchmark.Plan
    keys: dict[str, object] = field(default_factory=dict)
    parameters: dict[str, str] = field(default_factory=dict)
    sizes: list[tuple[int, int]] | None = None
    reference: Path | None = None
    reference_spp: int | None = None
    reference_cache: Path | None = None
    denoise: bool = False
    images: list[elsewhere.Image] = field(default_factory=list)

    def kinds(self) -> int:
        """Pictures of a scene."""
        steady = 1 + len(self.plan.frame_seconds) if self.plan.steady_frames else 0
        return len(self.specs) * (len(self.plan.seconds) + steady) * (2 if self.denoise else 1) + len(self.images)


@dataclass
class _Later:
    """A case that the workers will measure, with what all cases of its scene share, and what takes the rows."""

    job: jobs.Measurement
    shared: tuple[references.Reference, denoise.Guides | None]
    scene: str
    keep: Callable[[benchmark.Picture], None]


class Suite:
    """Compares on one scene after another. Each has its folder, a single one `folder` itself.

    An interruption marks the rendering under way, what was done before is reported, and the same settings go on from
    there. Of several scenes, one that cannot be loaded is left out, and so is an integrator that cannot render it;
    `notes` say so. With `workers` all cases of all scenes are measured by these, each by one of them and none beside
    another; references and the denoiser's guides are rendered here. `problem` says why not all of it was done.
    """

    def __init__(
        self, files: list[Path], settings: Settings, folder: Path, bars: Callable,
        workers: Workers | None = None,
    ) -> None:  # fmt: skip
        self.workers, self.problem = workers, ""
        self._later: list[_Later] = []
        self._grouped: list[Callable[[], None]] = []
        self.files, self.settings, self.folder, self.bars = files, settings, folder, bars
        self.results: list[report.SceneResult] = []
        self.notes: list[str] = []
        self.interrupted = False
        self._kept: list[kept.Kept] = []
        elsewhere.require_scenes(settings.images, collection.titles(files))
        # Images of one label are repeats of each other
        others = dict.fromkeys(image.label for image in settings.images)
        require_distinct([*(spec.label for spec in settings.specs), *others], "the files")
        if len(files) > 1:
            known = {name for file in files for name in load.scene_parameters(file)}
            if unknown := [name for name in settings.parameters if name not in known]:
                raise InputError(f"none of the scenes has a parameter {', '.join(unknown)}")

    def run(self) -> None:
        """Compare on all scenes; results go to `results`. A scene is forgotten before the next one is loaded."""
        for file, name in zip(self.files, collection.titles(self.files), strict=True):
            several = len(self.files) > 1
            try:
                self._scene(file, name, self.folder / name if several else self.folder)
            except KeyboardInterrupt:
                self.interrupted = True
                return
            except (ValueError, RuntimeError) as error:
                if not several:
                    raise
                self._leave_out(name, error)
            gc.collect()
        try:
            self._by_workers()
        except KeyboardInterrupt:
            self.interrupted = True
        except ClusterError as error:
            if len(self.files) == 1 and isinstance(error, JobError):
                raise
            self.interrupted, self.problem = True, str(error)
        finally:
            for group in self._grouped:
                group()

    def _by_workers(self) -> None:
        """Have the workers measure what was left to them."""
        if not self._later:
            return
        workers, todo = terminal.counted(self.workers.count(), "worker"), len(self._later)
        bar = self.bars(f"{terminal.counted(todo, 'case')} on {workers}")
        for done, (index, answer) in enumerate(self.workers.map([(case.job, case.shared) for case in self._later])):
            case = self._later[index]
            if isinstance(answer, JobError):
                if len(self.files) == 1:
                    raise answer
                self._leave_out(f"{case.job.setup.spec.label} on {case.scene}", answer)
                continue
            for picture in answer.value:
                picture.row.scene, picture.row.environment["worker"] = case.scene, answer.worker
                case.keep(picture)
            bar(done + 1, todo)

    def report(self, command: str) -> report.Report:
        """What was found so far."""
        notes = ["Interrupted: not all rows are there. The same command goes on from here."] if self.interrupted else []
        if note := report.repeats_note([g for scene in self.results for g in scene.groups]):
            notes.append(note)
        return report.Report(command, environment.describe(), self.results, notes + self.notes)

    def finish(self) -> None:
        """All is done and reported: the next run measures anew."""
        for of_scene in self._kept:
            of_scene.finish()

    def _leave_out(self, what: str, error: Exception) -> None:
        self.notes.append(f"{what} is left out: {load.one_line(error)}")
        terminal.announce(f"warning: {self.notes[-1]}")

    def _scene(self, file: Path, name: str, folder: Path) -> None:
        settings = self.settings
        folder.mkdir(parents=True, exist_ok=True)
        parameters = settings.parameters
        if len(self.files) > 1:
            has = load.scene_parameters(file)
            parameters = {key: value for key, value in parameters.items() if key in has}
        loaded = load.load_scene(str(file), settings.sizes, parameters)
        loaded.name = name
        cases = benchmark.make_cases(loaded, settings.specs, settings.keys, settings.denoise)
        labels = ", ".join(spec.label for spec in settings.specs)
        terminal.announce(f"{name} {loaded.size[0]}x{loaded.size[1]}, {labels}")
        elsewhere.check(elsewhere.of_scene(settings.images, name), loaded.size)
        reference = self._reference(loaded)
        notes = terminal.depth_notes(reference, loaded, cases)
        notes += terminal.notes(reference, settings.denoise, loaded.size)
        found = report.SceneResult(name, loaded.size, [], [], reference.to_json(), notes)
        self.results.append(found)

        def group() -> None:
            found.groups = repeats.group(found.rows)
            for of_kind in found.groups if settings.plan.repeats > 1 else []:
                repeats.tell_apart(of_kind, lambda row: row.image and exr.read(folder / row.image).rgb, reference)

        try:
            self._measure(loaded, cases, reference, found, folder)
        finally:
            if self.workers is None:
                group()
            else:
                self._grouped.append(group)

    def _measure(
        self, loaded: load.LoadedScene, cases: list[benchmark.Case], reference: references.Reference,
        found: report.SceneResult, folder: Path,
    ) -> None:  # fmt: skip
        """Fill in the rows and pictures of a scene; images and what is needed to go on are written to `folder`."""
        settings, plan = self.settings, self.settings.plan
        done = kept.Kept(folder, kept.settings_of(loaded, cases, plan, reference, settings.denoise))
        self._kept.append(done)
        if done.rows:
            terminal.announce(f"{len(done.rows)} rows are there already, of the same command interrupted")
        exposure = exr.automatic_exposure(reference.rgb)
        exr.write_png(folder / "reference.png", reference.rgb, exposure)
        most = page.picture_bytes(settings.kinds())
        found.entries.append(page.reference_entry(reference, exposure, most))

        def keep(picture: benchmark.Picture) -> None:
            row = picture.row
            if picture.rendered is not None:
                row.image = terminal.slug(row) + ".exr"
                terminal.write_image(folder / row.image, row, picture.rgb, picture.rendered)
            done.add(row)
            found.rows.append(row)
            if picture.rgb is not None and row.repeat == 0:
                exr.write_png(folder / (terminal.slug(row) + ".png"), picture.rgb, exposure)
                found.entries.append(page.entry(picture, exposure, most))

        self.bars("guides for the denoiser" if settings.denoise else "starting")
        guides = None
        if settings.denoise:
            guides, seconds = denoise.render_guides(loaded.scene, plan.seed)
            found.notes.append(f"The guides took {seconds:.2g} s, which no row contains.")
            reference = denoise.cleaned(reference, guides)
            if reference.clean is not None:
                found.notes.append("FLIP clean is measured against the denoised reference.")
        shared = reference, guides
        shown = elsewhere.of_scene(settings.images, found.name)
        for picture in elsewhere.pictures(shown, loaded, reference, environment.describe()):
            keep(picture)
        bench = benchmark.Bench(loaded, reference, guides, environment.describe(), keep, self.bars, done)
        for case in cases:
            if self.workers is not None:
                if not bench.recall(case, plan):
                    setup = jobs.Setup.of(loaded, case, loaded.size if settings.sizes else None)
                    self._later.append(_Later(jobs.Measurement(setup, plan), shared, found.name, keep))
                continue
            try:
                bench.run([case], plan)
            except (ValueError, RuntimeError) as error:
                if len(self.files) == 1:
                    raise
                self._leave_out(f"{case.spec.label} on {found.name}", error)

    def _reference(self, loaded: load.LoadedScene) -> references.Reference:
        """The image that was named, or the one beside the scene, or one that is rendered or was before."""
        settings = self.settings
        if settings.reference is not None:
            return references.of_film(settings.reference, loaded)
        found = references.beside(loaded.path, loaded.size, loaded.box_filter)
        if settings.reference_spp is None and found:
            return references.of_film(found, loaded)
        n = settings.reference_spp or DEFAULT_REFERENCE_SPP
        folder = settings.reference_cache or references.cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        try:
            return references.render_reference(loaded, n, folder, self.bars(f"reference, {n} samples a pixel"))
        except KeyboardInterrupt:
            raise KeyboardInterrupt("interrupted: the same command goes on with the reference") from None


def write(found: report.Report, folder: Path) -> None:
    """Write `results.json`, `results.csv`, `table.md`, `curves_*.svg` and `report.html`, each whole or not at all."""
    exr.write_text(folder / "results.json", json.dumps(report.results(found), indent=1) + "\n")
    exr.write_text(folder / "results.csv", report.comma_separated(found.rows))
    exr.write_text(folder / "table.md", report.tables(found))
    drawn = page.drawings(found)
    for (name, kind), svg in drawn.items():
        of_scene = re.sub(r"[^\w.-]+", "_", name) + "_" if len(found.scenes) > 1 else ""
        exr.write_text(folder / f"curves_{of_scene}{kind}.svg", svg)
    exr.write_text(folder / "report.html", page.page(found, drawn))
