"""`mi-neural compare`: integrators at equal time."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from mi_neural.commands import options
from mi_neural.measure import benchmark, denoise, environment, exr, kept, load, report, terminal
from mi_neural.measure import reference as references
from mi_neural.measure.load import InputError

DEFAULT_SECONDS = "1,2,4,8"
DEFAULT_FRAME_SECONDS = "0.25,1"
DEFAULT_REFERENCE_SPP = 1024


@options.readable
def compare(
    scene: options.Scene,
    integrator: Annotated[
        list[str] | None,
        typer.Option("-i", "--integrator", metavar="TYPE[:K=V,...]", help="repeatable; default: path and nirc"),
    ] = None,
    set_: options.Set = None,
    define: options.Define = None,
    seconds: Annotated[
        str | None, typer.Option(metavar="S,S,...", help=f"one-shot budgets; default {DEFAULT_SECONDS}")
    ] = None,
    steady: Annotated[int, typer.Option(metavar="FRAMES", help="train that many frames, then time frames")] = 0,
    frame_seconds: Annotated[
        str | None,
        typer.Option(metavar="S,S,...", help=f"budgets of a frame with --steady; default {DEFAULT_FRAME_SECONDS}"),
    ] = None,
    size: options.Size = None,
    seed: options.Seed = 0,
    variant: options.Variant = terminal.DEFAULT_VARIANT,
    reference: options.ReferenceFile = None,
    reference_spp: Annotated[
        int | None,
        typer.Option(metavar="N", help=f"render a reference by path and keep it; default {DEFAULT_REFERENCE_SPP}"),
    ] = None,
    denoise_: options.Denoise = False,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="DIR", help="folder for all results")] = None,
) -> None:
    """Integrators on SCENE at equal time: report.html, table.md, results.json, images. Ctrl-C keeps what is done.

    The same command goes on from there.
    """
    if output is None:
        raise InputError("compare needs a folder for its results: add -o DIR")
    if reference is not None and reference_spp is not None:
        raise InputError("--reference and --reference-spp exclude each other: give one of them")
    terminal.positive("--reference-spp", reference_spp)
    if steady < 0:
        raise InputError(f"--steady takes a number of frames from 1, got {steady}")
    if frame_seconds is not None and not steady:
        raise InputError("--frame-seconds needs --steady FRAMES")
    plan = benchmark.Plan(
        seconds=terminal.parse_seconds("--seconds", seconds or ("" if steady else DEFAULT_SECONDS)),
        steady_frames=steady,
        frame_seconds=terminal.parse_seconds(
            "--frame-seconds", frame_seconds or (DEFAULT_FRAME_SECONDS if steady else "")
        ),
        seed=seed,
    )
    specs = [load.parse_integrator(text) for text in integrator or ["path", "nirc"]]
    wanted_size, keys, parameters = (
        terminal.parse_size(size),
        load.parse_keys(set_ or []),
        terminal.parse_define(define),
    )
    if denoise_:
        denoise.require()
    terminal.require_folder(output)

    terminal.set_variant(variant)
    loaded = load.load_scene(scene, wanted_size, parameters)
    cases = benchmark.make_cases(loaded, specs, keys)
    ref = references.load_reference(reference, loaded.size) if reference else None
    terminal.announce(
        f"{loaded.name} {loaded.size[0]}x{loaded.size[1]}, {', '.join(s.label for s in specs)}, {variant}"
    )

    pictures: list[benchmark.Picture] = []

    def keep(picture: benchmark.Picture) -> None:
        row = picture.row
        if picture.rendered is not None:
            row.image = terminal.slug(row) + ".exr"
            terminal.write_image(output / row.image, row, picture.rgb, picture.rendered)
            exr.write_png(output / (terminal.slug(row) + ".png"), picture.rgb, exposure)
            done.add(row)
        pictures.append(picture)

    interrupted = False
    with terminal.Bars() as bars:
        if ref is None:
            n = reference_spp or DEFAULT_REFERENCE_SPP
            try:
                ref = references.render_reference(loaded, n, output, bars(f"reference, {n} samples a pixel"))
            except KeyboardInterrupt:
                raise KeyboardInterrupt("interrupted: the same command goes on with the reference") from None
        notes = terminal.depth_notes(ref, loaded, cases) + terminal.notes(ref, denoise_)
        exposure = exr.automatic_exposure(ref.rgb)
        exr.write_png(output / "reference.png", ref.rgb, exposure)
        done = kept.Kept(output, kept.settings_of(loaded, cases, plan, ref, denoise_))
        if done.rows:
            terminal.announce(f"{len(done.rows)} rows are there already, of the same command interrupted")
        try:
            bars("guides for the denoiser" if denoise_ else "starting")
            guides = denoise.render_guides(loaded.scene, seed) if denoise_ else None
            if guides:
                notes.append(f"The guides took {guides.seconds:.2g} s ({denoise.GUIDE_SPP} spp), counted for nobody.")
            bench = benchmark.Bench(loaded, ref, guides, environment.describe(), keep, bars, done)
            bench.run(cases, plan)
        except KeyboardInterrupt:
            interrupted = True
            notes.insert(0, "Interrupted: not all rows are there. The same command goes on from here.")

    rows = [p.row for p in pictures]
    command = shlex.join(["mi-neural", *sys.argv[1:]])
    found = report.Report(loaded.name, loaded.size, command, environment.describe(), rows, pictures, ref, notes)
    report.write(found, output)
    if not interrupted:
        done.finish()
    terminal.print_rows(rows)
    for note in notes:
        terminal.out.print(note, soft_wrap=True, markup=False)
    terminal.out.print(f"wrote {output / 'report.html'}", soft_wrap=True, markup=False)
    if interrupted:
        raise KeyboardInterrupt("interrupted: the same command goes on from here")
