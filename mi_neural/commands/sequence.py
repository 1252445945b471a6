"""`mi-neural sequence`: integrators on a scene that changes from frame to frame."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from mi_neural.bench import benchmark, changes, cluster, denoise, environment, load, plots, terminal
from mi_neural.bench import sequence as sequences
from mi_neural.bench.load import InputError
from mi_neural.bench.specs import parse_integrator, parse_keys
from mi_neural.bench.workers import ClusterError, connect
from mi_neural.commands import options

DEFAULT_FRAMES = 60
DEFAULT_REFERENCE_SPP = 256
#: A scene of more shapes is loaded anew with its meshes joined, where only cameras move.
MANY_SHAPES = 200
CHANGE_HELP = """a parameter of mi.traverse(scene), or the end of its name, as an expression of value (the original
one), frame, n, t (0 to 1), after (1 from --change-at on), s (frames since): "sun.direction=rotated(value, [0,1,0],
40*after)", "lamp.radiance=value*(1+t)", "ball.to_world=translate(0, 0.1*frame, 0) @ value" (meshes too), "wall.data=
bitmap('f_%04d.exr')"; repeatable"""


@options.readable
def sequence(
    scene: options.Scene,
    integrator: Annotated[
        list[str] | None,
        typer.Option(
            "-i",
            "--integrator",
            metavar="TYPE[:K=V,...]",
            help="an integrator and its keys, for example nirc:blend=fast; repeatable; default: path and nirc",
        ),
    ] = None,
    change: Annotated[list[str] | None, typer.Option(metavar="KEY=EXPR", help=CHANGE_HELP)] = None,
    frames: Annotated[int, typer.Option(metavar="N", help="number of frames")] = DEFAULT_FRAMES,
    change_at: Annotated[
        int | None, typer.Option(metavar="T", help="frame of an abrupt change, from which `after` is 1")
    ] = None,
    pretrain: Annotated[int, typer.Option(metavar="FRAMES", help="train so many frames before frame 0")] = 0,
    set_: options.Set = None,
    define: options.Define = None,
    spp: Annotated[int, typer.Option(help="samples a pixel of a frame")] = 1,
    size: options.Size = None,
    seed: options.Seed = 0,
    variant: options.Variant = terminal.DEFAULT_VARIANT,
    reference_spp: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help=f"samples of a reference, one for each state of the scene; default {DEFAULT_REFERENCE_SPP}",
        ),
    ] = None,
    no_reference: Annotated[
        bool, typer.Option("--no-reference", help="render no references: flicker (SMAPE) alone is measured")
    ] = False,
    crop: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,W,H", help="a region to show enlarged; repeatable; default: the most and the least changed one"
        ),
    ] = None,
    denoise_: options.Denoise = False,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="DIR", help="folder for all results")] = None,
    scheduler: options.Scheduler = None,
) -> None:
    """Compare integrators on a scene that changes from frame to frame.

    The folder gets frames, error and flicker over time, crops and an animated preview. After Ctrl-C the same command
    goes on. With --scheduler the workers render the frames, with
    caches that are trained here before the first one (train_steps=0); references are rendered here.
    """
    if output is None:
        raise InputError("sequence needs a folder for its results: add -o DIR")
    sequences.check_frames(frames, change_at)
    terminal.positive("--spp", spp)
    terminal.positive("--reference-spp", reference_spp)
    if pretrain < 0:
        raise InputError(f"--pretrain takes a number of frames from 0, got {pretrain}")
    if no_reference and reference_spp is not None:
        raise InputError("--no-reference and --reference-spp exclude each other: give one of them")
    if change_at is not None and not change:
        raise InputError("--change-at says when, but not what changes: add --change KEY=EXPR")
    functions = changes.parse(change or [], frames, change_at)
    specs = [parse_integrator(text) for text in integrator or ["path", "nirc"]]
    wanted_size, keys, parameters = (
        terminal.parse_size(size),
        parse_keys(set_ or []),
        terminal.parse_define(define),
    )
    if denoise_:
        denoise.require()
    terminal.require_folder(output)

    terminal.set_variant(variant)
    loaded = load.load_scene(scene, wanted_size, parameters, merge=not functions)
    if functions and len(loaded.scene.shapes()) > MANY_SHAPES and changes.of_sensors(loaded.scene, functions):
        loaded = load.load_scene(scene, wanted_size, parameters)
    crops = terminal.parse_crops(crop, loaded.size)
    cases = benchmark.make_cases(loaded, specs, keys, denoise_)
    over_time = sequences.Sequence(loaded.scene, functions, frames, change_at)
    terminal.announce(
        f"{loaded.name} {loaded.size[0]}x{loaded.size[1]}, {frames} frames, {len(set(over_time.states))} states, "
        f"{', '.join(s.label for s in specs)}, {variant}"
    )

    interrupted, problem, notes = False, "", []
    plan = sequences.Plan(spp, pretrain, seed, denoise_)
    with terminal.Bars() as bars, connect(scheduler) as workers:
        elsewhere = None
        if workers is not None:
            for case in cases:
                cluster.check(case, over_time=True)
            workers.count()  # waits for the first
            elsewhere = cluster.frames_of(workers, loaded, wanted_size, change or [], over_time, plan)
        run = sequences.Run(
            loaded,
            over_time,
            plan,
            output,
            None if no_reference else reference_spp or DEFAULT_REFERENCE_SPP,
            environment.describe(),
            bars,
            elsewhere,
        )
        try:
            run.run(cases)
        except KeyboardInterrupt:
            interrupted = True
            notes.append("Interrupted: not all frames are there. The same command goes on from here.")
        except ClusterError as error:
            problem = str(error)
            notes.append(f"Not all frames are there: {problem}. The same command goes on from here.")
        if run.references is not None and run.references.exposures is not None:
            first, exposures = run.references.of(0), run.references.exposures
            notes += terminal.depth_notes(first, loaded, cases) + terminal.notes(first, False, loaded.size)
            notes.append(
                f"FLIP: exposures {exposures.start:.2f} to {exposures.stop:.2f} stops in {exposures.num} steps for all "
                "frames, from the lowest to the highest that any of the references asks for."
            )
        notes.append("SMAPE at the change contains the change itself; means of SMAPE leave that frame out.")
        found = plots.Found(loaded, run, shlex.join(["mi-neural", *sys.argv[1:]]), crops, notes)
        bars("plots and preview")
        plots.write(found, output)

    if found.results:
        terminal.print_table(plots.table(found))
        for note in notes:
            terminal.out.print(note, soft_wrap=True, markup=False)
        terminal.out.print(f"wrote {output / 'report.html'}", soft_wrap=True, markup=False)
    if problem:
        raise InputError(f"{problem}; the same command goes on from here")
    if interrupted:
        raise KeyboardInterrupt("interrupted: the same command goes on from here")
