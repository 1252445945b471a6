"""`mi-neural render`: one image of one integrator, with its facts."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mi_neural.bench import benchmark, budget, cluster, denoise, environment, jobs, judging, load, repeats, terminal
from mi_neural.bench import reference as references
from mi_neural.bench.load import InputError
from mi_neural.bench.specs import IntegratorSpec, parse_integrator, parse_keys
from mi_neural.bench.workers import connect
from mi_neural.commands import options
from mi_neural.image import exr, moments

#: Seconds of training after which `render` writes a first image of one sample a pixel, to be replaced by the final one.
PREVIEW_SECONDS = 1.0


@dataclass
class Wanted:
    """What was typed, as far as more than one step needs it; names as those of the options."""

    spec: IntegratorSpec | None
    keys: dict[str, object]
    parameters: dict[str, str]
    size: tuple[int, int] | None
    spp: int | None
    seconds: float | None
    until_error: float | None
    pretrain: int
    seed: int
    output: Path | None
    reference: Path | None
    denoise: bool
    save_cache: Path | None
    load_cache: Path | None
    json: Path | None

    def check(self) -> None:
        """Refuse what cannot be done, before anything is loaded."""
        if self.denoise:
            denoise.require()
        if self.output is not None and self.output.suffix.lower() not in (".exr", ".png"):
            raise InputError(f"-o takes a file that ends in .exr or .png, got {self.output}")
        if self.load_cache is not None and not self.load_cache.is_file():
            raise InputError(f"no cache file {self.load_cache}: leave --load-cache out or write one with --save-cache")
        for file in (self.output or Path("image.exr"), self.json, self.save_cache):
            terminal.require_writable(file)

    def check_case(self, case: benchmark.Case) -> None:
        """Refuse what cannot be done with this integrator, and files of one name."""
        terminal.require_cache_methods(case, self.pretrain, self.save_cache, self.load_cache)
        if self.until_error is not None and getattr(case.integrator, "cumulative", False):
            raise InputError("--until-error compares passes, but images of this integrator hold all passes before them")
        files = {"-o": self.output, "--json": self.json, "--reference": self.reference}
        # A cache may be written back
        for more in ({"--load-cache": self.load_cache}, {"--save-cache": self.save_cache}):
            terminal.require_different({**files, **more})


@options.readable
def render(
    scene: options.Scene,
    integrator: Annotated[
        str | None,
        typer.Option(
            "-i",
            "--integrator",
            metavar="TYPE[:K=V,...]",
            help="an integrator and its keys, for example nirc:cache_samples=8; default: the scene's own, else path",
        ),
    ] = None,
    set_: options.Set = None,
    define: options.Define = None,
    spp: Annotated[int | None, typer.Option(help="samples a pixel; default: those of the scene")] = None,
    seconds: Annotated[
        float | None, typer.Option(help="wall time in place of samples; training counts, compiling does not")
    ] = None,
    until_error: Annotated[
        float | None,
        typer.Option(
            metavar="E", help="render until the estimated trimmed relMSE (noise, not bias) is E, at most --seconds"
        ),
    ] = None,
    pretrain: Annotated[int, typer.Option(metavar="FRAMES", help="train that many frames before the clock starts")] = 0,
    size: options.Size = None,
    seed: options.Seed = 0,
    variant: options.Variant = terminal.DEFAULT_VARIANT,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT.exr|png", help="default: SCENE_INTEGRATOR.exr")
    ] = None,
    reference: options.ReferenceFile = None,
    denoise_: options.Denoise = False,
    save_cache: Annotated[Path | None, typer.Option(metavar="FILE", help="write the trained cache to FILE")] = None,
    load_cache: Annotated[
        Path | None, typer.Option(metavar="FILE", help="start with a cache that --save-cache wrote")
    ] = None,
    json_: Annotated[
        Path | None, typer.Option("--json", metavar="OUT.json", help="write times, samples, errors and settings")
    ] = None,
    scheduler: options.Scheduler = None,
) -> None:
    """Render SCENE to an EXR with metadata, or to a PNG.

    The image so far is written every minute, and after Ctrl-C. If training takes long, a first image of one sample a
    pixel is written after one second of it. With --scheduler the cache is trained here, and the workers render.
    """
    check_budget(spp, seconds, until_error, pretrain, scheduler)
    wanted_size, keys, parameters = (
        terminal.parse_size(size),
        parse_keys(set_ or []),
        terminal.parse_define(define),
    )
    spec = parse_integrator(integrator) if integrator else None
    wanted = Wanted(
        spec, keys, parameters, wanted_size, spp, seconds, until_error, pretrain, seed, output, reference, denoise_,
        save_cache, load_cache, json_,
    )  # fmt: skip
    wanted.check()

    terminal.set_variant(variant)
    loaded, case = load_case(scene, wanted)
    wanted.output = wanted.output or Path(f"{loaded.name}_{case.spec.type}.exr")
    wanted.check_case(case)
    ref = references.of_film(reference, loaded) if reference else None
    terminal.depth_notes(ref, loaded, [case])
    if ref is not None and (note := references.scale_note(ref, loaded.size)):
        terminal.announce(note)
    terminal.announce(f"{loaded.name} {loaded.size[0]}x{loaded.size[1]}, {case.spec.label}, {variant}")

    job = Job(wanted, loaded, case)
    with terminal.Bars() as bars, connect(scheduler) as workers:
        job.prepare(bars, workers)
        stopped = job.train(bars)
        rendered = job.render(bars, workers, stopped)
        image, seconds_denoise = job.denoised(rendered)
    job.write(rendered, image, seconds_denoise, ref)
    if rendered.problem:
        raise InputError(f"{rendered.problem}; the image has {rendered.spp} of {job.n} samples a pixel")
    if rendered.interrupted:
        raise KeyboardInterrupt(f"interrupted: the image has {rendered.spp} samples a pixel")


def check_budget(
    spp: int | None, seconds: float | None, until_error: float | None, pretrain: int, scheduler: str | None
) -> None:  # fmt: skip
    """Refuse numbers of samples, seconds and frames that are out of range or exclude each other."""
    if spp is not None and seconds is not None:
        raise InputError("--spp and --seconds exclude each other: give one of them")
    if scheduler is not None and seconds is not None:
        raise InputError("--seconds is time of this process; with --scheduler give --spp")
    terminal.positive("--spp", spp)
    terminal.positive("--seconds", seconds)
    terminal.positive("--until-error", until_error)
    if until_error is not None and (spp is not None or scheduler is not None):
        raise InputError("--until-error chooses the samples itself: leave out --spp and --scheduler")
    if pretrain < 0:
        raise InputError(f"--pretrain takes a number of frames from 0, got {pretrain}")


def load_case(scene: str, wanted: Wanted) -> tuple[load.LoadedScene, benchmark.Case]:
    """The scene, and the integrator that was named or is the scene's own."""
    spec, keys = wanted.spec, wanted.keys
    loaded = load.load_scene(scene, wanted.size, wanted.parameters, None if spec else keys)
    if not spec:
        return loaded, benchmark.own_case(loaded, keys)
    spec.keys = {**keys, **spec.keys}
    return loaded, benchmark.make_cases(loaded, [spec], denoise=wanted.denoise)[0]


@dataclass
class Job:
    """One image under way.

    n           samples a pixel, where no clock and no error decides
    guides      of the denoiser
    seconds_*   of pretraining, of training before the first sample, of previews in it
    first_image seconds from the start of the process to the first image that was written
    estimate    of the error, with `--until-error`
    """

    wanted: Wanted
    loaded: load.LoadedScene
    case: benchmark.Case
    n: int = 0
    guides: object = None
    seconds_pretrain: float = 0.0
    seconds_first: float = 0.0
    seconds_preview: float = 0.0
    first_image: float | None = None
    estimate: object = None

    @property
    def subject(self) -> tuple:
        return self.loaded.scene, self.case.integrator

    def prepare(self, bars: terminal.Bars, workers) -> None:
        """Render the denoiser's guides, compile, and read the cache."""
        wanted, (scene, integrator) = self.wanted, self.subject
        if wanted.denoise:
            bars("guides for the denoiser")
            self.guides, _ = denoise.render_guides(scene, wanted.seed)
            denoise.warm_up(self.guides)
        self.n = wanted.spp or self.loaded.default_spp
        if workers is None:
            bars("compiling")
            by_clock = wanted.seconds or wanted.until_error
            sizes = budget.pass_sizes(scene) if by_clock else sorted(set(budget.plan_passes(scene, self.n)))
            if wanted.seconds is None and not hasattr(integrator, "prepare"):
                sizes = sizes[:1]  # Mitsuba's kernels are the same for every number of samples
            self.case.seconds_compile = budget.warm_up(scene, integrator, sizes, wanted.seed)
        else:
            cluster.check(self.case)
        if wanted.load_cache is not None:
            integrator.load_cache(str(wanted.load_cache))

    def train(self, bars: terminal.Bars) -> bool:
        """Train what is trained before the first sample. Returns whether that was interrupted."""
        wanted, (scene, integrator) = self.wanted, self.subject
        bar = bars(f"training {wanted.pretrain} frames") if wanted.pretrain else None
        self.seconds_pretrain, stopped = budget.train(scene, integrator, wanted.pretrain, progress=bar)
        if (wanted.seconds is None or wanted.until_error) and not stopped:
            bar = self.previewed(bars("training")) if hasattr(integrator, "train_first") else None
            self.seconds_first, stopped = budget.train_first(scene, integrator, progress=bar)
        return stopped

    def render(self, bars: terminal.Bars, workers, stopped: bool) -> budget.Rendered:
        """Render to the number of samples, the seconds or the error; one sample at once if training was `stopped`."""
        wanted, (scene, integrator) = self.wanted, self.subject
        if stopped:  # the image that is there at once
            rendered = budget.render_samples(scene, integrator, 1, wanted.seed)
            rendered.interrupted = True
        elif wanted.until_error is not None:
            bar = bars(f"rendering until the error is {wanted.until_error:g}")
            # Training counts
            left = None if wanted.seconds is None else max(wanted.seconds - self.seconds_first, 0.0)
            rendered, self.estimate = budget.render_until(
                scene, integrator, wanted.until_error, left, wanted.seed, progress=bar, keep=self.keep,
                trained=None if wanted.pretrain or wanted.load_cache else self.seconds_first,
            )  # fmt: skip
        elif wanted.seconds is not None:
            bar = bars(f"rendering for {wanted.seconds:g} s")
            rendered = budget.render_seconds(
                scene, integrator, wanted.seconds, wanted.seed, progress=bar,
                pretrained=bool(wanted.pretrain or wanted.load_cache), keep=self.keep,
            )  # fmt: skip
        elif workers is not None:
            setup = jobs.Setup.of(self.loaded, self.case, wanted.size, own=wanted.spec is None)
            bar = bars(f"rendering {self.n} samples a pixel on {terminal.counted(workers.count(), 'worker')}")
            rendered = cluster.render_samples(
                setup, self.loaded, self.case, self.n, wanted.seed, workers, progress=bar, keep=self.keep
            )
        else:
            bar = bars(f"rendering {self.n} samples a pixel")
            rendered = budget.render_samples(scene, integrator, self.n, wanted.seed, progress=bar, keep=self.keep)
        rendered.seconds_train += self.seconds_first - self.seconds_preview
        return rendered

    def denoised(self, rendered: budget.Rendered) -> tuple:
        """(The image to write, seconds of the denoiser)."""
        return denoise.denoise(rendered.rgb, self.guides) if self.wanted.denoise else (rendered.rgb, 0.0)

    def write(self, rendered: budget.Rendered, image, seconds_denoise: float, ref) -> None:
        """Write the image, its facts and the cache, and say what was written."""
        wanted = self.wanted
        row = self.describe(rendered, image, seconds_denoise)
        terminal.write_image(wanted.output, row, image, rendered)
        if ref is not None:
            judging.judge(row, [image], ref)
            terminal.write_image(wanted.output, row, image, rendered)  # again, with the errors among its facts
        if wanted.json is not None:
            exr.write_text(wanted.json, json.dumps(row.to_json(), indent=1) + "\n")
        if wanted.save_cache is not None:
            self.case.integrator.save_cache(str(wanted.save_cache))
        terminal.print_rows(repeats.group([row]))
        first = f"first image {row.seconds_to_first_image:.1f} s after the start"
        terminal.out.print(f"wrote {wanted.output}; {first}", soft_wrap=True, markup=False)
        if (estimate := self.estimate) is not None:
            contains = f"{estimate.bias:.2g} of it the bias of the cache" if estimate.bias else "of the noise alone"
            terminal.out.print(
                f"estimated trimmed relMSE {estimate.value:.3g} ({100 * moments.CONFIDENCE:.0f} % interval "
                f"{estimate.low:.3g} to {estimate.high:.3g}), {contains}, at {rendered.spp} samples a pixel",
                soft_wrap=True, markup=False,
            )  # fmt: skip

    def describe(self, rendered: budget.Rendered, image, seconds_denoise: float = 0.0) -> benchmark.Row:
        """The facts of an image."""
        wanted = self.wanted
        row = benchmark.make_row(
            self.loaded, self.case, "one-shot" if wanted.seconds is not None else "spp", [rendered], [image],
            wanted.seed, denoised=wanted.denoise and image is not rendered.rgb, seconds_denoise=seconds_denoise,
            environment=environment.describe(), budget_seconds=wanted.seconds, pretrain_frames=wanted.pretrain,
            seconds_pretrain=self.seconds_pretrain,
        )  # fmt: skip
        row.image = str(wanted.output)
        row.seconds_to_first_image = self.first_image or environment.seconds_since_start()
        return row

    def keep(self, so_far: budget.Rendered) -> None:
        """Write the image so far."""
        terminal.write_image(self.wanted.output, self.describe(so_far, so_far.rgb), so_far.rgb, so_far)
        self.first_image = self.first_image or environment.seconds_since_start()

    def previewed(self, progress: budget.Progress) -> budget.Progress:
        """`progress` of training, which also writes a first image after some time of it."""
        start = budget.clock()

        def advance(done: float, total: float) -> None:
            progress(done, total)
            now = budget.clock()
            if self.first_image is not None or done >= total or now - start < PREVIEW_SECONDS:
                return
            if (so_far := budget.preview(*self.subject, self.wanted.seed)) is not None:
                self.keep(so_far)
            self.seconds_preview += budget.clock() - now

        return advance
