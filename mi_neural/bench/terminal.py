"""What the commands of `mi-neural` share: reading what was typed, checking it before work is done, bars and tables."""

from __future__ import annotations

import os
import re
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mi_neural.bench import benchmark, budget, load, repeats, report
from mi_neural.bench import reference as references
from mi_neural.bench.load import InputError
from mi_neural.bench.specs import file_name
from mi_neural.image import exr

DEFAULT_VARIANT = "llvm_ad_rgb"

out, err = Console(highlight=False), Console(stderr=True, highlight=False)

# ------------------------------------------------------------------------------------------------------------------
# Reading and checking what was typed


def parse_size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d+)[xX](\d+)", text.strip())
    if not match or min(int(match[1]), int(match[2])) < 1:
        raise InputError(f"--size takes WIDTHxHEIGHT in pixels, both at least 1, like 640x360; got {text!r}")
    return int(match[1]), int(match[2])


def parse_sizes(text: str | None) -> list[tuple[int, int]] | None:
    """Sizes separated by commas: each scene takes the one nearest in shape to its own film."""
    return None if text is None else [parse_size(part) for part in text.split(",")]


def parse_seconds(option: str, text: str) -> list[float]:
    try:
        seconds = [float(part) for part in text.split(",")] if text else []
    except ValueError:
        raise InputError(f"{option} takes seconds separated by commas, like 1,2,4; got {text!r}") from None
    for s in seconds:
        positive(option, s)
    return sorted(dict.fromkeys(seconds))


def parse_crops(texts: list[str] | None, size: tuple[int, int]) -> list[tuple[int, int, int, int]]:
    crops = []
    for text in texts or []:
        match = re.fullmatch(r"(\d+),(\d+),(\d+),(\d+)", text.replace(" ", ""))
        x, y, w, h = map(int, match.groups()) if match else (0, 0, 0, 0)
        if not match or min(w, h) < 1 or x + w > size[0] or y + h > size[1]:
            raise InputError(f"--crop takes x,y,width,height in pixels within {size[0]}x{size[1]}, like 0,0,32,32; "
                             f"got {text!r}")  # fmt: skip
        crops.append((x, y, w, h))
    return crops


def parse_define(texts: list[str] | None) -> dict[str, str]:
    pairs = {}
    for text in texts or []:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise InputError(f"-D takes name=value, got {text!r}")
        pairs[name.lstrip("$")] = value
    return pairs


def positive(option: str, value: float | None) -> None:
    if value is not None and not (0 < value < float("inf")):
        raise InputError(f"{option} must be greater than 0, got {value}")


def set_variant(variant: str) -> None:
    import drjit as dr
    import mitsuba as mi

    if variant not in mi.variants():
        raise InputError(f"unknown variant {variant!r}; available: {', '.join(mi.variants())}")
    if variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise InputError(
            f"{variant} needs an NVIDIA GPU and its driver, none was found: use --variant {DEFAULT_VARIANT}"
        )
    mi.set_variant(variant)


def require_writable(file: Path | None) -> None:
    """Find out before rendering whether a file can be written, by writing another beside it."""
    if file is None:
        return
    if file.is_dir():
        raise InputError(f"{file} is a folder: give the name of a file in it")
    if not exr.is_special(file):
        require_folder(file.parent)
    elif not os.access(file, os.W_OK):
        raise InputError(f"cannot write to {file}")


def require_different(files: dict[str, Path | None]) -> None:
    """Refuse two options that name one file, which the later would overwrite."""
    seen: dict[Path, str] = {}
    for option, file in files.items():
        if file is None or exr.is_special(file):
            continue
        if (first := seen.setdefault(file.resolve(), option)) != option:
            raise InputError(f"{first} and {option} name the same file, {file}: give each its own")


def require_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write to the folder {folder}: {error.strerror or error}") from None


def require_cache_methods(
    case: benchmark.Case, pretrain: int, save_cache: Path | None, load_cache: Path | None
) -> None:
    """Raise :class:`InputError` where an option would have no effect: the integrator has no cache, or, to be trained,
    neither one nor a light sampler that learns."""
    has_cache = hasattr(case.integrator, "save_cache")
    sampler = getattr(case.integrator, "light_sampler", None)
    for option, asked, able in (
        ("--pretrain", pretrain, has_cache or getattr(sampler, "cache", None) is not None),
        ("--save-cache", save_cache, has_cache),
        ("--load-cache", load_cache, has_cache),
    ):
        if asked and not able:
            raise InputError(
                f"{option}: {case.spec.type} has no cache; choose an integrator that has one, like -i nirc"
            )


def depth_notes(
    reference: references.Reference | None, loaded: load.LoadedScene, cases: list[benchmark.Case]
) -> list[str]:
    """A line, also printed as a warning, for each integrator whose depth is not the reference's."""
    notes = []
    for case in cases if reference is not None else []:
        if "max_depth" not in case.keys and "max_depth" in loaded.carried:
            continue  # it has no such key
        depth = getattr(case.integrator, "max_depth", case.keys.get("max_depth", -1))
        direct = getattr(case.integrator, "direct_only", False)
        if text := references.depth_warning(reference, depth, direct):
            notes.append(f"{case.spec.label}: {text}")
            announce(f"warning: {notes[-1]}")
    return notes


# ------------------------------------------------------------------------------------------------------------------
# Being stopped

_stopped: list[int] = []


def stop_alike() -> None:
    """Have SIGTERM (schedulers, `kill`) stop the program as Ctrl-C does: with what is done on disk."""

    def stop(number, frame):
        _stopped.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)


def stopped_by() -> int:
    """The signal that stopped the program."""
    return _stopped[-1] if _stopped else int(signal.SIGINT)


# ------------------------------------------------------------------------------------------------------------------
# Writing and showing


class Bars:
    """One progress bar on stderr, named anew for each step: `bars("training")` returns a callable (done, total).

    Where stderr is no terminal, the name of each step is printed instead.
    """

    def __init__(self) -> None:
        self.progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=err,
            transient=True,
            disable=not err.is_terminal,
            refresh_per_second=4,
        )

    def __enter__(self) -> Bars:
        self.progress.__enter__()
        self.task = self.progress.add_task("", total=None)
        return self

    def __exit__(self, *exception) -> None:
        self.progress.__exit__(*exception)

    def __call__(self, text: str) -> Callable[[float, float], None]:
        if self.progress.disable:
            announce(text)
        self.progress.reset(self.task, description=text, total=None, completed=0)
        return lambda done, total: self.progress.update(self.task, completed=done, total=total)


def counted(n: int, noun: str) -> str:
    """`1 worker`, `2 workers`."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def announce(text: str) -> None:
    err.print(text, soft_wrap=True, markup=False)


def write_image(path: Path, row: benchmark.Row, image, rendered: budget.Rendered) -> None:
    """Write an image with its facts. Where that fails, as on a full disk, another place is tried before it is lost."""
    try:
        _write_image(path, row, image, rendered)
    except OSError as error:
        refuge = Path(tempfile.mkdtemp(prefix="mi-neural-")) / path.name
        try:
            _write_image(refuge, row, image, rendered)
        except OSError:
            refuge.parent.rmdir()
            raise error from None
        raise OSError(f"cannot write {path} ({load.one_line(error)}); the image is in {refuge}") from None


def _write_image(path: Path, row: benchmark.Row, image, rendered: budget.Rendered) -> None:
    if path.suffix.lower() == ".png":
        exr.write_png(path, image)
        return
    channels = dict(rendered.channels)
    if row.denoised:
        channels.update(exr.layer_channels("noisy", rendered.rgb))
    facts = row.to_json()
    statistics = facts.pop("statistics")
    exr.write(path, image, channels, {**facts, **({"statistics": statistics} if statistics else {})})


def slug(row: benchmark.Row) -> str:
    """A file name for a row: nirc_cache_samples-8_steady_0.25s_denoised_2 (second repeat)."""
    parts = [
        file_name(row.label),
        row.mode,
        f"{row.budget_seconds:g}s" if row.budget_seconds else "",
        "denoised" if row.denoised else "",
        str(row.repeat + 1) if row.repeat else "",
    ]
    return "_".join(part for part in parts if part)


def notes(reference: references.Reference, denoised: bool, size: tuple[int, int]) -> list[str]:
    scaled = references.scale_note(reference, size)
    notes = [scaled] if scaled else []
    spp = reference.metadata.get("spp", "unknown")
    if reference.variance is None:
        notes.append(f"Reference: {spp} spp; it carries no variance, so its own noise is part of every error.")
    else:
        notes.append(
            f"Reference: {spp} spp, standard error of a pixel {100 * reference.standard_error():.2g} %; that noise, "
            f"{reference.noise_floor():.2g} in relMSE, is subtracted from both relMSE figures and not from FLIP."
        )
    if denoised:
        notes.append("One-shot budgets do not contain the denoiser's time, frames of steady rows do.")
    return notes


def print_rows(groups: list[repeats.Group]) -> None:
    """The table of rows that were grouped by their repeats, and what was left out."""
    shown = [g for g in groups if g.first.mode != "split"]
    if not shown:
        return
    print_table(report.table(shown))
    if n := sum(row.nonfinite for g in shown for row in g.rows):
        out.print(f"{n} non-finite samples or pixels were left out", markup=False)


def print_table(lines: list[list[str]]) -> None:
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    for line in lines:
        cells = [c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(line, widths, strict=True))]
        out.print("  ".join(cells), soft_wrap=True, markup=False)
