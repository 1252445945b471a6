"""The command `mi-neural`: render a scene, compare integrators at equal time or over a changing scene, say what is
installed.

Progress goes to stderr and results to stdout. Exit codes: 0 done, 2 the input cannot be used (one line says why),
130 (Ctrl-C) and 143 (SIGTERM) interrupted, with what was rendered so far on disk.
"""

from __future__ import annotations

import functools
import json
import os
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from mi_neural.measure import benchmark, budget, changes, denoise, environment, exr, kept, load, plots, report, terminal
from mi_neural.measure import reference as references
from mi_neural.measure import sequence as sequences
from mi_neural.measure.load import InputError

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help=__doc__.split("\n\n")[0],
)
DEFAULT_SECONDS = "1,2,4,8"
DEFAULT_FRAME_SECONDS = "0.25,1"
DEFAULT_REFERENCE_SPP = 1024
DEFAULT_FRAMES = 60
DEFAULT_SEQUENCE_REFERENCE_SPP = 256

# ------------------------------------------------------------------------------------------------------------------
# Options shared by the commands

Scene = Annotated[str, typer.Argument(metavar="SCENE", help="a Mitsuba XML file, or the name of a shipped scene")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="a key of the integrator; a.b=v reaches into a nested plugin"),
]
Define = Annotated[
    list[str] | None, typer.Option("--define", "-D", metavar="NAME=VALUE", help="a $parameter of the scene")
]
Size = Annotated[str | None, typer.Option(metavar="WxH", help="size of the film, whatever the scene says")]
Seed = Annotated[int, typer.Option(min=0, help="same seed, same image")]
Variant = Annotated[str, typer.Option(help="Mitsuba variant")]
ReferenceFile = Annotated[
    str | None, typer.Option("--reference", metavar="REF.exr", help="measure errors against this image")
]
Denoise = Annotated[bool, typer.Option("--denoise", help="Open Image Denoise with albedo and normals as guides")]


def readable(command: Callable) -> Callable:
    """Run a command so that what goes wrong is one line on stderr and an exit code."""

    @functools.wraps(command)
    def wrapper(*args, **kwargs):
        try:
            return command(*args, **kwargs)
        except KeyboardInterrupt as error:
            terminal.err.print(str(error) or "interrupted", soft_wrap=True, markup=False)
            raise typer.Exit(128 + terminal.stopped_by()) from None
        except (ValueError, OSError, ImportError, RuntimeError) as error:
            if os.environ.get("MI_NEURAL_TRACEBACK"):
                raise
            hint = "" if isinstance(error, (InputError, ImportError)) else " (MI_NEURAL_TRACEBACK=1 shows where)"
            terminal.err.print(f"mi-neural: {load.one_line(error)}{hint}", soft_wrap=True, markup=False)
            raise typer.Exit(2) from None

    return wrapper


# ------------------------------------------------------------------------------------------------------------------
# Commands


@app.command()
@readable
def render(
    scene: Scene,
    integrator: Annotated[
        str | None,
        typer.Option("-i", "--integrator", metavar="TYPE[:K=V,...]", help="default: the scene's own, else path"),
    ] = None,
    set_: Set = None,
    define: Define = None,
    spp: Annotated[int | None, typer.Option(help="samples a pixel; default: what the scene says")] = None,
    seconds: Annotated[
        float | None, typer.Option(help="wall time instead of samples, training included, compiling not")
    ] = None,
    pretrain: Annotated[int, typer.Option(metavar="FRAMES", help="train that many frames before the clock starts")] = 0,
    size: Size = None,
    seed: Seed = 0,
    variant: Variant = terminal.DEFAULT_VARIANT,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT.exr|png", help="default: SCENE_INTEGRATOR.exr")
    ] = None,
    reference: ReferenceFile = None,
    denoise_: Denoise = False,
    save_cache: Annotated[Path | None, typer.Option(metavar="FILE", help="keep what was learned")] = None,
    load_cache: Annotated[Path | None, typer.Option(metavar="FILE", help="start from what was learned")] = None,
    json_: Annotated[Path | None, typer.Option("--json", metavar="OUT.json", help="write the facts")] = None,
) -> None:
    """Render SCENE to an EXR with metadata, or a PNG. Ctrl-C keeps the image so far, as is done every minute."""
    if spp is not None and seconds is not None:
        raise InputError("--spp and --seconds exclude each other: give one of them")
    terminal.positive("--spp", spp)
    terminal.positive("--seconds", seconds)
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
        case = benchmark.make_cases(loaded, [spec])[0]
    else:
        case = benchmark.own_case(loaded, keys)
    terminal.require_cache_methods(case, pretrain, save_cache, load_cache)
    output = output or Path(f"{loaded.name}_{case.spec.type}.exr")
    ref = references.load_reference(reference, loaded.size) if reference else None
    terminal.depth_notes(ref, loaded, [case])
    terminal.announce(f"{loaded.name} {loaded.size[0]}x{loaded.size[1]}, {case.spec.label}, {variant}")

    seconds_pretrain = 0.0

    def describe(rendered: budget.Rendered, image, seconds_denoise: float = 0.0) -> benchmark.Row:
        row = benchmark.make_row(
            loaded, case, "one-shot" if seconds is not None else "spp", [rendered], [image], seed,
            denoised=denoise_ and image is not rendered.rgb, seconds_denoise=seconds_denoise,
            environment=environment.describe(), budget_seconds=seconds, pretrain_frames=pretrain,
            seconds_pretrain=seconds_pretrain,
        )  # fmt: skip
        row.image = str(output)
        return row

    def keep(so_far: budget.Rendered) -> None:
        terminal.write_image(output, describe(so_far, so_far.rgb), so_far.rgb, so_far)

    with terminal.Bars() as bars:
        if denoise_:
            bars("guides for the denoiser")
            guides = denoise.render_guides(loaded.scene, seed)
            denoise.warm_up(guides)
        bars("compiling")
        n = spp or loaded.default_spp
        sizes = budget.pass_sizes(loaded.scene) if seconds else sorted(set(budget.plan_passes(loaded.scene, n)))
        if seconds is None and not hasattr(case.integrator, "prepare"):
            sizes = sizes[:1]  # Mitsuba's kernels are the same for every number of samples
        case.seconds_compile = budget.warm_up(loaded.scene, case.integrator, sizes, seed)
        if load_cache is not None:
            case.integrator.load_cache(str(load_cache))
        bars_pretrain = bars(f"training {pretrain} frames") if pretrain else None
        seconds_pretrain, stopped = budget.train(loaded.scene, case.integrator, pretrain, progress=bars_pretrain)
        seconds_first = 0.0
        if seconds is None and not stopped:
            bars_first = bars("training") if hasattr(case.integrator, "train_first") else None
            seconds_first, stopped = budget.train_first(loaded.scene, case.integrator, progress=bars_first)
        if stopped:  # the image that can be had at once
            rendered = budget.render_samples(loaded.scene, case.integrator, 1, seed)
            rendered.interrupted = True
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
        else:
            rendered = budget.render_samples(
                loaded.scene, case.integrator, n, seed, progress=bars(f"rendering {n} samples a pixel"), keep=keep
            )
        rendered.seconds_train += seconds_first
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
    terminal.print_rows([row])
    terminal.out.print(f"wrote {output}", soft_wrap=True, markup=False)
    if rendered.interrupted:
        raise KeyboardInterrupt(f"interrupted: the image has {rendered.spp} samples a pixel")


@app.command()
@readable
def compare(
    scene: Scene,
    integrator: Annotated[
        list[str] | None,
        typer.Option("-i", "--integrator", metavar="TYPE[:K=V,...]", help="repeatable; default: path and nirc"),
    ] = None,
    set_: Set = None,
    define: Define = None,
    seconds: Annotated[
        str | None, typer.Option(metavar="S,S,...", help=f"one-shot budgets; default {DEFAULT_SECONDS}")
    ] = None,
    steady: Annotated[int, typer.Option(metavar="FRAMES", help="train that many frames, then time frames")] = 0,
    frame_seconds: Annotated[
        str | None,
        typer.Option(metavar="S,S,...", help=f"budgets of a frame with --steady; default {DEFAULT_FRAME_SECONDS}"),
    ] = None,
    size: Size = None,
    seed: Seed = 0,
    variant: Variant = terminal.DEFAULT_VARIANT,
    reference: ReferenceFile = None,
    reference_spp: Annotated[
        int | None,
        typer.Option(metavar="N", help=f"render a reference by path and keep it; default {DEFAULT_REFERENCE_SPP}"),
    ] = None,
    denoise_: Denoise = False,
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


CHANGE_HELP = """a parameter of mi.traverse(scene), or the end of its name, as an expression of value (the original
one), frame, n, t (0 to 1), after (1 from --change-at on), s (frames since): "sun.direction=rotated(value, [0,1,0],
40*after)", "lamp.radiance=value*(1+t)", "ball.to_world=translate(0, 0.1*frame, 0) @ value" (meshes too), "wall.data=
bitmap('f_%04d.exr')"; repeatable"""


@app.command()
@readable
def sequence(
    scene: Scene,
    integrator: Annotated[
        list[str] | None,
        typer.Option("-i", "--integrator", metavar="TYPE[:K=V,...]", help="repeatable; default: path and nirc"),
    ] = None,
    change: Annotated[list[str] | None, typer.Option(metavar="KEY=EXPR", help=CHANGE_HELP)] = None,
    frames: Annotated[int, typer.Option(metavar="N", help="number of frames")] = DEFAULT_FRAMES,
    change_at: Annotated[
        int | None, typer.Option(metavar="T", help="frame of an abrupt change: `after` and `s` count from it")
    ] = None,
    pretrain: Annotated[int, typer.Option(metavar="FRAMES", help="train that many frames before frame 0")] = 0,
    set_: Set = None,
    define: Define = None,
    spp: Annotated[int, typer.Option(help="samples a pixel of a frame")] = 1,
    size: Size = None,
    seed: Seed = 0,
    variant: Variant = terminal.DEFAULT_VARIANT,
    reference_spp: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help=f"samples of a reference, one per state of the scene; default {DEFAULT_SEQUENCE_REFERENCE_SPP}",
        ),
    ] = None,
    no_reference: Annotated[bool, typer.Option("--no-reference", help="no references: SMAPE alone")] = False,
    crop: Annotated[
        list[str] | None, typer.Option(metavar="X,Y,W,H", help="repeatable; default: most and least changed region")
    ] = None,
    denoise_: Denoise = False,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="DIR", help="folder for all results")] = None,
) -> None:
    """SCENE changing from frame to frame: frames, error and flicker over time, crops, an animated preview.

    Ctrl-C keeps what is done; the same command goes on from there.
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
    loaded = load.load_scene(scene, wanted_size, parameters, merge=False)
    crops = terminal.parse_crops(crop, loaded.size)
    cases = benchmark.make_cases(loaded, specs, keys)
    over_time = sequences.Sequence(loaded.scene, functions, frames, change_at)
    terminal.announce(
        f"{loaded.name} {loaded.size[0]}x{loaded.size[1]}, {frames} frames, {len(set(over_time.states))} states, "
        f"{', '.join(s.label for s in specs)}, {variant}"
    )

    interrupted, notes = False, []
    with terminal.Bars() as bars:
        run = sequences.Run(
            loaded,
            over_time,
            sequences.Plan(spp, pretrain, seed, denoise_),
            output,
            None if no_reference else reference_spp or DEFAULT_SEQUENCE_REFERENCE_SPP,
            environment.describe(),
            bars,
        )
        try:
            run.run(cases)
        except KeyboardInterrupt:
            interrupted = True
            notes.append("Interrupted: not all frames are there. The same command goes on from here.")
        if run.references is not None and run.references.exposures is not None:
            first, exposures = run.references.of(0), run.references.exposures
            notes += terminal.depth_notes(first, loaded, cases) + terminal.notes(first, False)
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
    if interrupted:
        raise KeyboardInterrupt("interrupted: the same command goes on from here")


@app.command()
@readable
def info() -> None:
    """Versions, variants, LLVM, cores."""
    import mitsuba as mi

    import mi_neural
    from mi_neural import emitters, integrators, registration, scenes

    facts = environment.describe()
    llvm = mi_neural.llvm.describe()
    facts["variant"] = f"{terminal.DEFAULT_VARIANT} by default; plugins work under {', '.join(registration.SUPPORTED)}"
    facts["llvm"] = llvm["version"] and f"{llvm['version']} from {llvm['source']}: {llvm['path']}"
    del facts["llvm_source"]
    if llvm["problem"]:
        facts["llvm problem"] = llvm["problem"]
    facts["variants"] = ", ".join(mi.variants())
    facts["integrators"] = ", ".join(registration.plugin_names(integrators))
    facts["emitters"] = ", ".join(registration.plugin_names(emitters))
    facts["scenes"] = ", ".join(scenes.names())

    table = Table.grid(padding=(0, 2))
    for name, value in facts.items():
        missing = "not installed: pip install 'mi_neural[denoise]'" if name == "mitsuba-oidn" else "none"
        table.add_row(name, str(value or missing))
    terminal.out.print(table)


def main() -> None:
    """Entry point of the program."""
    terminal.stop_alike()
    app()


if __name__ == "__main__":
    main()
