"""`mi-neural render`: one image of one integrator, with its facts."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from mi_neural.bench import benchmark, budget, cluster, denoise, environment, jobs, load, repeats, terminal
from mi_neural.bench import reference as references
from mi_neural.bench.load import InputError
from mi_neural.bench.workers import connect
from mi_neural.commands import options
from mi_neural.image import exr, moments

#: Seconds of training after which `render` writes a first image of one sample a pixel, to be replaced by the final one.
PREVIEW_SECONDS = 1.0


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
    wanted_size, keys, parameters = (
        terminal.parse_size(size),
        load.parse_keys(set_ or []),
        terminal.parse_define(define),
    )
    spec = load.parse_integrator(integrator) if integrator else None
    if denoise_:
        denoise.require()
    if output is not None and output.suffix.lower() not in (".exr", ".png"):
        raise InputError(f"-o takes a file that ends in .exr or .png, got {output}")
    if load_cache is not None and not load_cache.is_file():
        raise InputError(f"no cache file {load_cache}: leave --load-cache out or write one with --save-cache")
    for file in (output or Path("image.exr"), json_, save_cache):
        terminal.require_writable(file)

    terminal.set_variant(variant)
    loaded = load.load_scene(scene, wanted_size, parameters, None if spec else keys)
    if spec:
        spec.keys = {**keys, **spec.keys}
        case = benchmark.make_cases(loaded, [spec], denoise=denoise_)[0]
    else:
        case = benchmark.own_case(loaded, keys)
    terminal.require_cache_methods(case, pretrain, save_cache, load_cache)
    if until_error is not None and getattr(case.integrator, "cumulative", False):
        raise InputError("--until-error compares passes, but images of this integrator hold all passes before them")
    output = output or Path(f"{loaded.name}_{case.spec.type}.exr")
    files = {"-o": output, "--json": json_, "--reference": Path(reference) if reference else None}
    for more in ({"--load-cache": load_cache}, {"--save-cache": save_cache}):  # a cache may be written back
        terminal.require_different({**files, **more})
    ref = references.of_film(reference, loaded) if reference else None
    terminal.depth_notes(ref, loaded, [case])
    if ref is not None and (note := references.scale_note(ref, loaded.size)):
        terminal.announce(note)
    terminal.announce(f"{loaded.name} {loaded.size[0]}x{loaded.size[1]}, {case.spec.label}, {variant}")

    seconds_pretrain, seconds_preview, first_image, estimate = 0.0, 0.0, None, None

    def describe(rendered: budget.Rendered, image, seconds_denoise: float = 0.0) -> benchmark.Row:
        row = benchmark.make_row(
            loaded, case, "one-shot" if seconds is not None else "spp", [rendered], [image], seed,
            denoised=denoise_ and image is not rendered.rgb, seconds_denoise=seconds_denoise,
            environment=environment.describe(), budget_seconds=seconds, pretrain_frames=pretrain,
            seconds_pretrain=seconds_pretrain,
        )  # fmt: skip
        row.image, row.seconds_to_first_image = str(output), first_image or environment.seconds_since_start()
        return row

    def keep(so_far: budget.Rendered) -> None:
        nonlocal first_image
        terminal.write_image(output, describe(so_far, so_far.rgb), so_far.rgb, so_far)
        first_image = first_image or environment.seconds_since_start()

    def previewed(progress: budget.Progress) -> budget.Progress:
        """`progress` of training, which also writes a first image after some time of it."""
        start = budget.clock()

        def advance(done: float, total: float) -> None:
            nonlocal seconds_preview
            progress(done, total)
            now = budget.clock()
            if first_image is not None or done >= total or now - start < PREVIEW_SECONDS:
                return
            if (so_far := budget.preview(loaded.scene, case.integrator, seed)) is not None:
                keep(so_far)
            seconds_preview += budget.clock() - now

        return advance

    with terminal.Bars() as bars, connect(scheduler) as workers:
        if denoise_:
            bars("guides for the denoiser")
            guides, _ = denoise.render_guides(loaded.scene, seed)
            denoise.warm_up(guides)
        n = spp or loaded.default_spp
        if workers is None:
            bars("compiling")
            by_clock = seconds or until_error
            sizes = budget.pass_sizes(loaded.scene) if by_clock else sorted(set(budget.plan_passes(loaded.scene, n)))
            if seconds is None and not hasattr(case.integrator, "prepare"):
                sizes = sizes[:1]  # Mitsuba's kernels are the same for every number of samples
            case.seconds_compile = budget.warm_up(loaded.scene, case.integrator, sizes, seed)
        else:
            cluster.check(case)
        if load_cache is not None:
            case.integrator.load_cache(str(load_cache))
        bars_pretrain = bars(f"training {pretrain} frames") if pretrain else None
        seconds_pretrain, stopped = budget.train(loaded.scene, case.integrator, pretrain, progress=bars_pretrain)
        seconds_first = 0.0
        if (seconds is None or until_error) and not stopped:
            bars_first = previewed(bars("training")) if hasattr(case.integrator, "train_first") else None
            seconds_first, stopped = budget.train_first(loaded.scene, case.integrator, progress=bars_first)
        if stopped:  # the image that is there at once
            rendered = budget.render_samples(loaded.scene, case.integrator, 1, seed)
            rendered.interrupted = True
        elif until_error is not None:
            bar = bars(f"rendering until the error is {until_error:g}")
            left = None if seconds is None else max(seconds - seconds_first, 0.0)  # training counts
            rendered, estimate = budget.render_until(
                loaded.scene, case.integrator, until_error, left, seed, progress=bar, keep=keep
            )
        elif seconds is not None:
            rendered = budget.render_seconds(
                loaded.scene,
                case.integrator,
                seconds,
                seed,
                progress=bars(f"rendering for {seconds:g} s"),
                pretrained=bool(pretrain or load_cache),
                keep=keep,
            )
        elif workers is not None:
            setup = jobs.Setup.of(loaded, case, wanted_size, own=spec is None)
            bar = bars(f"rendering {n} samples a pixel on {terminal.counted(workers.count(), 'worker')}")
            rendered = cluster.render_samples(setup, loaded, case, n, seed, workers, progress=bar, keep=keep)
        else:
            rendered = budget.render_samples(
                loaded.scene, case.integrator, n, seed, progress=bars(f"rendering {n} samples a pixel"), keep=keep
            )
        rendered.seconds_train += seconds_first - seconds_preview
        image, seconds_denoise = rendered.rgb, 0.0
        if denoise_:
            image, seconds_denoise = denoise.denoise(rendered.rgb, guides)

    row = describe(rendered, image, seconds_denoise)
    terminal.write_image(output, row, image, rendered)
    if ref is not None:
        benchmark.judge(row, [image], ref)
        terminal.write_image(output, row, image, rendered)  # again, with the errors among its facts
    if json_ is not None:
        exr.write_text(json_, json.dumps(row.to_json(), indent=1) + "\n")
    if save_cache is not None:
        case.integrator.save_cache(str(save_cache))
    terminal.print_rows(repeats.group([row]))
    first = f"first image {row.seconds_to_first_image:.1f} s after the start"
    terminal.out.print(f"wrote {output}; {first}", soft_wrap=True, markup=False)
    if estimate is not None:
        terminal.out.print(
            f"estimated trimmed relMSE {estimate.value:.3g} ({100 * moments.CONFIDENCE:.0f} % interval "
            f"{estimate.low:.3g} to {estimate.high:.3g}), of the noise alone, at {rendered.spp} samples a pixel",
            soft_wrap=True, markup=False,
        )  # fmt: skip
    if rendered.problem:
        raise InputError(f"{rendered.problem}; the image has {rendered.spp} of {n} samples a pixel")
    if rendered.interrupted:
        raise KeyboardInterrupt(f"interrupted: the image has {rendered.spp} samples a pixel")
