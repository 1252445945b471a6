"""Tables out of benchmark rows: as text, Markdown, HTML, JSON, CSV.

Rows that differ by their repeat alone are one line of a table, with a confidence interval (:mod:`.repeats`).
"""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields

import numpy as np

from .benchmark import Row, plain
from .repeats import LEVEL, Group

#: Headings and cells of every table, in order.
COLUMNS = (
    ("integrator", lambda g: name_of(g.first)),
    ("mode", lambda g: g.first.mode),
    ("budget s", lambda g: number(g.first.budget_seconds)),
    ("spp", lambda g: number(g.mean("spp"))),
    ("train s", lambda g: number(g.mean("seconds_train"))),
    ("render s", lambda g: number(g.mean("seconds_render"))),
    ("denoise s", lambda g: number(g.mean("seconds_denoise")) if g.first.denoised else ""),
    ("ns/sample", lambda g: number(g.mean("ns_per_sample"))),
    ("relMSE trimmed", lambda g: interval(g, "relmse_trimmed")),
    ("bias²", lambda g: number(g.squared_bias) + _error(g.squared_bias_error)),
    ("variance", lambda g: number(g.variance)),
    ("relMSE", lambda g: interval(g, "relmse")),
    ("FLIP", lambda g: interval(g, "flip")),
    ("FLIP clean", lambda g: interval(g, "flip_clean")),
    ("flicker", lambda g: interval(g, "flicker")),
    ("peak MiB", lambda g: number(_rounded(g.mean("peak_mib")))),
)
#: Columns in which one value is the best of those of one budget, and whether that is the least or the largest.
BEST = {
    "spp": (lambda g: g.mean("spp"), max), "ns/sample": (lambda g: g.mean("ns_per_sample"), min),
    "relMSE trimmed": (lambda g: g.mean("relmse_trimmed"), min), "bias²": (lambda g: g.squared_bias, min),
    "variance": (lambda g: g.variance, min), "relMSE": (lambda g: g.mean("relmse"), min),
    "FLIP": (lambda g: g.mean("flip"), min), "FLIP clean": (lambda g: g.mean("flip_clean"), min),
    "flicker": (lambda g: g.mean("flicker"), min), "peak MiB": (lambda g: g.mean("peak_mib"), min),
}  # fmt: skip
#: Parts of a frame, as :class:`.split.Split` names them.
PARTS = ("train", "query", "trace", "film", "python")
#: Fields of a row that a table of numbers has no room for.
NESTED = ("parameters", "statistics", "environment", "split", "size")


@dataclass
class SceneResult:
    """Results of one scene. `reference`: :meth:`.Reference.to_json`; `entries`: the pictures of :mod:`.page`; `notes`:
    lines that a reader must know."""

    name: str
    size: tuple[int, int]
    rows: list[Row]
    groups: list[Group]
    reference: dict[str, object] | None
    notes: list[str] = field(default_factory=list)
    entries: list[dict[str, object]] = field(default_factory=list)


@dataclass
class Report:
    """What a comparison found; `command` is what was typed, `notes` concern all scenes."""

    command: str
    environment: dict[str, object]
    scenes: list[SceneResult]
    notes: list[str] = field(default_factory=list)

    @property
    def rows(self) -> list[Row]:
        return [row for scene in self.scenes for row in scene.rows]


def table(groups: Iterable[Group]) -> list[list[str]]:
    """Cells as text, the headings first; columns that are empty in every line, or of one mode, are left out."""
    groups = list(groups)
    columns = COLUMNS if len({g.first.mode for g in groups}) > 1 else [c for c in COLUMNS if c[0] != "mode"]
    cells = [[name for name, _ in columns], *([cell(g) for _, cell in columns] for g in groups)]
    kept = [k for k in range(len(columns)) if any(line[k] for line in cells[1:])]
    return [[line[k] for k in kept] for line in cells]


def best(groups: Iterable[Group]) -> set[tuple[int, int]]:
    """Places (line, column) in :func:`table` of the best values among the lines of one budget, where they differ."""
    groups = list(groups)
    places = set()
    for column, heading in enumerate(table(groups)[0]):
        if heading not in BEST:
            continue
        value, which = BEST[heading]
        for budget in dict.fromkeys(g.first.budget_seconds for g in groups):
            found = {k: v for k, g in enumerate(groups, 1) if g.first.budget_seconds == budget
                     and (v := value(g)) is not None}  # fmt: skip
            if len(set(found.values())) > 1:
                places |= {(k, column) for k, v in found.items() if v == which(found.values())}
    return places


def best_of_summary(cells: list[list[str]]) -> set[tuple[int, int]]:
    """Places (line, column) in a :func:`summary` of each scene's least trimmed relMSE and of the largest factor."""
    places = set()
    for column in range(1, len(cells[0])):
        texts = {k: line[column].partition(" ")[0] for k, line in enumerate(cells) if k}
        found = {k: float(text) for k, text in texts.items() if text}
        which = max if cells[0][column] == "factor" else min
        if len(set(found.values())) > 1:
            places |= {(k, column) for k, v in found.items() if v == which(found.values())}
    return places


def split_table(groups: Iterable[Group]) -> list[list[str]]:
    """Where the time of a one-sample frame goes, in milliseconds and per cent; empty without such rows."""
    lines = []
    for g in groups:
        found = [row.split for row in g.rows if row.split]
        if not found:
            continue
        means = {name: np.mean([s[name] or 0.0 for s in found]) for name in ("total", *PARTS)}
        parts = [f"{1e3 * means[p]:.2f} ({100 * means[p] / means['total']:.0f} %)" if means[p] else "" for p in PARTS]
        compile_ = number(max(row.seconds_compile for row in g.rows))
        lines.append([name_of(g.first), compile_, f"{1e3 * means['total']:.1f}", *parts])
    return [["integrator", "compile s", "frame ms", *PARTS], *lines] if lines else []


def errors_of(report: Report) -> str:
    """The errors in a cell of :func:`summary`."""
    clean = any(row.flip_clean is not None for row in report.rows)
    return "trimmed relMSE / FLIP" + (" / FLIP clean" if clean else "")


def summary(report: Report) -> list[tuple[str, list[list[str]]]]:
    """One table for each mode and budget: integrators over scenes, trimmed relMSE / FLIP / FLIP clean (which is there
    with a denoiser), and by which factor trimmed relMSE is below that of the first integrator with as much denoising: a
    geometric mean over the scenes where neither is below what the reference resolves, left out where a scene is
    missing."""
    tables = []
    groups = [g for scene in report.scenes for g in scene.groups if g.mean("relmse_trimmed") is not None]
    for mode, budget in dict.fromkeys((g.first.mode, g.first.budget_seconds) for g in groups):
        if mode == "split":
            continue
        of_mode = [g for g in groups if (g.first.mode, g.first.budget_seconds) == (mode, budget)]
        kinds = list(dict.fromkeys((g.first.label, g.first.denoised) for g in of_mode))
        cells = [["integrator", *(scene.name for scene in report.scenes), "factor"]]
        for label, denoised in kinds:
            errors, texts = {}, []
            for scene in report.scenes:
                found = {g.key: g for g in scene.groups}
                g = found.get((label, mode, budget, denoised))
                values = [] if g is None else [g.mean("relmse_trimmed"), g.mean("flip")]
                if g is not None and (clean := g.mean("flip_clean")) is not None:
                    values.append(clean)
                texts.append(" / ".join(map(number, values)))
                first = found.get((kinds[0][0], mode, budget, denoised))
                if g is not None and first is not None:
                    errors[scene.name] = first.mean("relmse_trimmed"), g.mean("relmse_trimmed")
            ratios = [np.log(a / b) for a, b in errors.values() if a and b]
            complete = ratios and len(errors) == len(report.scenes)
            cells.append([label + (" + denoiser" if denoised else ""), *texts,
                          number(float(np.exp(np.mean(ratios)))) if complete else ""])  # fmt: skip
        tables.append((f"{mode}{f' {budget:g} s' if budget else ''}", cells))
    return tables


def results(report: Report) -> dict[str, object]:
    """What `results.json` holds."""
    return plain(
        {
            "command": report.command,
            "environment": report.environment,
            "notes": report.notes,
            "scenes": [
                {"scene": s.name, "size": s.size, "reference": s.reference, "notes": s.notes} for s in report.scenes
            ],
            "groups": [g.to_json() for scene in report.scenes for g in scene.groups],
            "rows": [row.to_json() for row in report.rows],
        }
    )


def comma_separated(rows: Iterable[Row]) -> str:
    """The rows as CSV: all that is a number, a text or a truth, keys of integrators and parts of frames beside it."""
    names = [f.name for f in fields(Row) if f.name not in NESTED]
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([*names, "width", "height", "parameters", *(f"split_{part}" for part in ("total", *PARTS))])
    for row in rows:
        values = plain(asdict(row))
        parameters = " ".join(f"{k}={v}" for k, v in values["parameters"].items())
        parts = [(values["split"] or {}).get(part) for part in ("total", *PARTS)]
        writer.writerow([*(values[name] for name in names), *row.size, parameters, *parts])
    return buffer.getvalue()


def tables(report: Report) -> str:
    """All tables in Markdown."""
    several = len(report.scenes) > 1
    parts = [f"## {title}\n\n{markdown(cells)}" for title, cells in summary(report)] if several else []
    for scene in report.scenes:
        heading = f"## {scene.name} {scene.size[0]}x{scene.size[1]}\n\n" if several else ""
        cells = table(g for g in scene.groups if g.first.mode != "split")
        parts.append(heading + (markdown(cells) if len(cells) > 1 else ""))
        if frames := split_table(scene.groups):
            parts.append(markdown(frames))
    return "\n".join(parts)


def markdown(cells: list[list[str]]) -> str:
    """A table, its headings first, in Markdown."""
    head, *body = cells
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines) + "\n"


def html_table(cells: list[list[str]], marked: set[tuple[int, int]] = frozenset()) -> str:
    """A table, its headings first, in HTML; cells at the places (line, column) of `marked` have the class `best`."""

    def cell(k: int, column: int, text: str) -> str:
        tag, kind = "td" if k else "th", ' class="best"' if (k, column) in marked else ""
        return f"<{tag}{kind}>{html.escape(text)}</{tag}>"

    lines = ("".join(cell(k, column, text) for column, text in enumerate(line)) for k, line in enumerate(cells))
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def name_of(row: Row) -> str:
    """An integrator's label, and whether its image was denoised."""
    return row.label + (" + denoiser" if row.denoised else "")


def repeats_note(groups: list[Group]) -> str | None:
    """How the intervals in the tables were made; None where nothing was repeated."""
    n = max((len(g.rows) for g in groups), default=0)
    if n < 2:
        return None
    return (
        f"{n} repeats with independent seeds, of images and of training: figures are means, ± is half of Student's "
        f"{100 * LEVEL:.0f} % confidence interval of the mean. Bias² and variance are those of one image, in sum about "
        "trimmed relMSE. Bias² comes from products of different repeats, so that their noise cancels, less the "
        "reference's variance; its ± is one standard error, over the repeats (jackknife) and of the reference. It is "
        "not resolved below the reference's own noise in relMSE, as errors are divided by a noisy reference."
    )


def interval(found: Group, name: str) -> str:
    """Mean and half-width of a field, `0.0123 ± 0.0004`; the mean alone where there is one row."""
    return number(found.mean(name)) + _error(found.half_width(name))


def _error(value: float | None) -> str:
    return "" if value is None else f" ± {value:.2g}"


def _rounded(value: float | None) -> int | None:
    return None if value is None else round(value)


def number(value: float | int | None) -> str:
    """Three significant digits, no exponent where it can be avoided, empty for None."""
    if value is None:
        return ""
    if value == 0 or isinstance(value, int) or float(value).is_integer():
        return str(int(value))
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
