"""`mi-neural compare`: integrators at equal time, on one scene or several."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from mi_neural.bench import benchmark, collection, denoise, elsewhere, report, suite, terminal
from mi_neural.bench.load import InputError
from mi_neural.bench.specs import parse_integrator, parse_keys
from mi_neural.bench.workers import connect
from mi_neural.commands import options

DEFAULT_SECONDS = "1,2,4,8"
DEFAULT_FRAME_SECONDS = "0.25,1"


@options.readable
def compare(
    scene: Annotated[
        list[str] | None,
        typer.Argument(metavar="SCENE", help="Mitsuba XML files, or names that mi-neural scenes lists"),
    ] = None,
    scenes: Annotated[
        Path | None, typer.Option(metavar="DIR", help="also all scene files in a folder and below it")
    ] = None,
    integrator: Annotated[
        list[str] | None,
        typer.Option(
            "-i",
            "--integrator",
            metavar="TYPE[:K=V,...]",
            help="an integrator and its keys, for example nirc:cache_samples=8; repeatable; default: path and nirc",
        ),
    ] = None,
    set_: options.Set = None,
    define: options.Define = None,
    seconds: Annotated[
        str | None,
        typer.Option(metavar="S,S,...", help=f"seconds of one image from an empty cache; default {DEFAULT_SECONDS}"),
    ] = None,
    steady: Annotated[
        int, typer.Option(metavar="FRAMES", help="train so many frames, then measure frames of a running sequence")
    ] = 0,
    frame_seconds: Annotated[
        str | None,
        typer.Option(metavar="S,S,...", help=f"seconds of a frame with --steady; default {DEFAULT_FRAME_SECONDS}"),
    ] = None,
    repeats: Annotated[
        int, typer.Option(metavar="N", help="measure with N seeds: confidence intervals, bias, variance")
    ] = 1,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH,...", help="size of the film; of several, each scene takes the one nearest to its own shape"
        ),
    ] = None,
    seed: options.Seed = 0,
    variant: options.Variant = terminal.DEFAULT_VARIANT,
    reference: options.ReferenceFile = None,
    reference_spp: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="render references by path with N samples and keep them; default: the image beside a scene, or "
            f"{suite.DEFAULT_REFERENCE_SPP} samples",
        ),
    ] = None,
    reference_cache: Annotated[
        Path | None, typer.Option(metavar="DIR", help="where rendered references are kept; default: the user's cache")
    ] = None,
    denoise_: options.Denoise = False,
    image: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FILE.exr,seconds=T[,...]",
            help="an image that another renderer made in T seconds (its denoiser not counted), repeatable; more: "
            "spp=N, denoised=true, scene=NAME",
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="DIR", help="folder for all results")] = None,
    scheduler: options.Scheduler = None,
) -> None:
    """Compare integrators at equal time: errors, curves and pictures.

    The folder gets report.html, tables, results.json, results.csv and images. After Ctrl-C the same command goes on.
    """
    if output is None:
        raise InputError("compare needs a folder for its results: add -o DIR")
    if reference is not None and reference_spp is not None:
        raise InputError("--reference and --reference-spp exclude each other: give one of them")
    terminal.positive("--reference-spp", reference_spp)
    terminal.positive("--repeats", repeats)
    if steady < 0:
        raise InputError(f"--steady takes a number of frames from 1, got {steady}")
    if frame_seconds is not None and not steady:
        raise InputError("--frame-seconds needs --steady FRAMES")
    files = collection.choose(scene, scenes)
    if reference is not None and len(files) > 1:
        raise InputError(f"--reference belongs to one scene, not to {len(files)}: leave it out")
    plan = benchmark.Plan(
        seconds=terminal.parse_seconds("--seconds", seconds or ("" if steady else DEFAULT_SECONDS)),
        steady_frames=steady,
        frame_seconds=terminal.parse_seconds(
            "--frame-seconds", frame_seconds or (DEFAULT_FRAME_SECONDS if steady else "")
        ),
        seed=seed,
        repeats=repeats,
    )
    settings = suite.Settings(
        specs=[parse_integrator(text) for text in integrator or ["path", "nirc"]],
        plan=plan,
        keys=parse_keys(set_ or []),
        parameters=terminal.parse_define(define),
        sizes=terminal.parse_sizes(size),
        reference=reference,
        reference_spp=reference_spp,
        reference_cache=reference_cache,
        denoise=denoise_,
        images=[elsewhere.parse(text) for text in image or []],
    )
    if denoise_:
        denoise.require()
    terminal.require_folder(output)
    if reference_cache is not None:
        terminal.require_folder(reference_cache)

    terminal.set_variant(variant)
    with terminal.Bars() as bars, connect(scheduler) as workers:
        comparison = suite.Suite(files, settings, output, bars, workers)
        comparison.run()
    found = comparison.report(shlex.join(["mi-neural", *sys.argv[1:]]))
    if not found.scenes:
        if comparison.interrupted:
            raise KeyboardInterrupt("interrupted: the same command goes on with the reference")
        raise InputError("; ".join(found.notes))
    suite.write(found, output)
    if not comparison.interrupted:
        comparison.finish()
    if len(found.scenes) == 1:
        terminal.print_rows(found.scenes[0].groups)
    for title, cells in report.summary(found) if len(found.scenes) > 1 else []:
        terminal.out.print(f"\n{title}: {report.errors_of(found)}", markup=False)
        terminal.print_table(cells)
    for note in found.notes + (found.scenes[0].notes if len(found.scenes) == 1 else []):
        terminal.out.print(note, soft_wrap=True, markup=False)
    terminal.out.print(f"wrote {output / 'report.html'}", soft_wrap=True, markup=False)
    if comparison.problem:
        raise InputError(f"{comparison.problem}; the same command goes on from here")
    if comparison.interrupted:
        raise KeyboardInterrupt("interrupted: the same command goes on from here")
