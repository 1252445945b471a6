"""Tables and figures of README and manual, written from `docs/results/*.json`: `python docs/tables.py`.

A file holds a table's `title`, `columns` and `rows`, and where they come from: `commit` and `date` of the version that
was measured, `machine`, `mitsuba`, the `command` that makes them again (null: the script was not kept; `how` says it in
words), and `paths`, the code that the numbers depend on.

A row is a list of cells, or an object with `cells` and what differs for that row.
A cell is a text, a number, or a list of numbers; `formats` says how a list is written, by its length. Numbers are
written with the digits that the file has. `best` numbers the columns in each row of which the lowest is set in bold
(`best_values`: of lists, so many numbers alone).
A file with `figure` describes a picture in the same way.

In Markdown a table stands between `<!-- results: NAME -->` and `<!-- end -->`. A table whose numbers were not measured
(defaults, versions) follows a line `<!-- no results: REASON -->`.

A number in prose is written from the mark behind it: `0.5<!-- value: NAME; ROW; COLUMN -->`. ROW is the first cell of a
row, or `CELL&CELL` where it takes the second one, too, to tell rows apart; an empty cell counts as that above it.
COLUMN is the column's title; of a list of numbers, `COLUMN#2` takes the second. `*` stands for any text, and backticks
are left out. ` / ` and the end of a second address (COLUMN, ROW; COLUMN or all) make a ratio. `mean`, `least` and
`most` in place of `value` take several rows: their geometric mean, or one of them. For example:
`?<!-- mean: public_shots; *&10 s; neural_path#1 / path#1 -->`.
A paragraph with numbers of others contains, or follows, `<!-- no results: REASON -->`.
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import textwrap
from functools import cache
from itertools import zip_longest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs/results"
BLOCK = re.compile(r"^( *)<!-- results: (\S+) -->\n(.*?)^ *<!-- end -->$", re.M | re.S)
EXEMPT = re.compile(r"<!-- no results: \S.* -->")
VALUE = re.compile(r"((?<![\w.])-?\d*\.?\d+(?:e[-+]?\d+)?|\?)?(<!--\s+(value|mean|least|most):\s+(.*?)\s+-->)", re.S)
#: What is no prose: code, links, the time of a frame or shot, versions.
NO_PROSE = re.compile(r"^```(?s:.*?)^```$|(?:\A|\n\s*\n)(?: {4}(?! *[-*|] ).*(?:\n|\Z))+|``?[^`]+``?|\]\([^)]*\)|"
                      r"doi:\S+|\b(?:frames?|shots?)\sof\s[\d.]+ s\b|(?:[Vv]ersion|Python|Mitsuba)\s[\d.]*\d",
                      re.M)  # fmt: skip
UNIT = r"(?: ?%|\s(?:ms|us|ns|s|seconds|MiB|GiB|MB|times)\b)"
#: What seems measured: decimals, and numbers of percent, times, seconds, memory.
FIGURE = re.compile(rf"(?<![\w.])-?[\d,]*(?:\.\d+(?:e[-+]?\d+)?|\de-\d+|\d(?={UNIT})){UNIT}?")
SOURCE = ("commit", "date", "machine", "mitsuba", "command", "paths")
WIDTH = 150


class ResultsError(ValueError):
    """A table that cannot be written; the message says which, and what to do."""


class Number(str):
    """A number with the digits in which a file has it."""


# ------------------------------------------------------------------------------------------------------------------
# Files


def pages() -> list[Path]:
    """The Markdown files whose tables are written from results."""
    return [ROOT / "README.md", ROOT / "docs/index.md", *sorted((ROOT / "mi_neural/manual").glob("*.md"))]


def read(name: str) -> dict:
    """The results of that name. Raises `ResultsError`."""
    file = RESULTS / f"{name}.json"
    if not file.is_file():
        raise ResultsError(f"there are no results '{name}'; write {file.relative_to(ROOT)}")
    found = json.loads(file.read_text(encoding="utf-8"), parse_float=Number, parse_int=Number)
    missing = [key for key in (*SOURCE, "title") if key not in found]
    if missing:
        raise ResultsError(f"{file.relative_to(ROOT)} says nothing of: {', '.join(missing)}")
    for row in rows(found):
        if len(row["cells"]) != len(found["columns"]):
            raise ResultsError(f"{file.relative_to(ROOT)}: {len(found['columns'])} columns, but a row of "
                               f"{len(row['cells'])}: {row['cells'][0]}")  # fmt: skip
    return found


def rows(results: dict) -> list[dict]:
    """The rows, each with its cells and where it comes from."""
    source = {key: results[key] for key in SOURCE}
    given = results.get("rows", [])
    return [source | (row if isinstance(row, dict) else {"cells": row}) for row in given]


def encoded(results: dict) -> str:
    """Results as the text of their file: a row a line, numbers with their digits."""

    def text(value) -> str:
        if isinstance(value, Number):
            return str(value)
        if isinstance(value, dict):
            return "{" + ", ".join(f"{text(k)}: {text(v)}" for k, v in value.items()) + "}"
        if isinstance(value, list):
            return "[" + ", ".join(map(text, value)) + "]"
        return json.dumps(value, ensure_ascii=False)

    lines = []
    for key, value in results.items():
        shown = text(value)
        if key == "rows":
            shown = "[\n  " + ",\n  ".join(map(text, value)) + "\n ]"
        lines.append(f" {text(key)}: {shown}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


# ------------------------------------------------------------------------------------------------------------------
# Markdown


def written(name: str, page: Path, indent: str = "") -> str:
    """What stands between the two marks, in `page`."""
    found = read(name)
    if "figure" in found:
        lines = [f"![{found['alt']}]({os.path.relpath(ROOT / found['figure'], page.parent)})"]
    else:
        lines = [_line(found["columns"]), "|" + "---|" * len(found["columns"])]
        lines += [_line(_cells(found, row["cells"])) for row in rows(found)]
    caption = textwrap.wrap(f"*{caption_of(found)}*", WIDTH, break_long_words=False, break_on_hyphens=False)
    return "".join(f"{indent}{line}".rstrip() + "\n" for line in [*lines, "", *caption])


def caption_of(results: dict) -> str:
    """Title, age, machine and command of a table or a figure."""
    sources = rows(results) or [results]
    dates = sorted({row["date"] for row in sources})
    commits = list(dict.fromkeys(row["commit"] for row in sources))
    when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    commands = list(dict.fromkeys(row["command"] for row in sources))
    how = results.get("how") or " and ".join(f"`{c}`" if c else "a script that was not kept" for c in commands)
    where = f"{results['machine']}, Mitsuba {results['mitsuba']}"
    return f"{results['title']} Made {when} ({', '.join(commits)}), {where}, by {how}."


def _line(cells: list[str]) -> str:
    return "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"


def _cells(results: dict, cells: list) -> list[str]:
    """The cells of a row as text, with the lowest numbers of the columns `best` in bold."""
    best = [int(k) for k in results.get("best", [])]
    lists = {k: _values(cells[k]) for k in best if _values(cells[k])}
    n = min(int(results.get("best_values", 9)), max(map(len, lists.values()), default=0))
    lowest = [min(float(v[i]) for v in lists.values() if i < len(v)) for i in range(n)]

    def text(k: int) -> str:
        cell = cells[k]
        values = _values(cell)
        if not values:
            return str(cell)
        if k in lists:
            values = [f"**{v}**" if float(v) == low else v for v, low in zip_longest(values, lowest)]
        template = "{}" if isinstance(cell, Number) else (
            cell["as"] if isinstance(cell, dict) else results["formats"][str(len(values))])  # fmt: skip
        return template.format(*values)

    return [text(k) for k in range(len(cells))]


def _values(cell) -> list[Number]:
    """The numbers of a cell; empty for a text."""
    if isinstance(cell, Number):
        return [cell]
    return cell["values"] if isinstance(cell, dict) else cell if isinstance(cell, list) else []


def rewritten(text: str, page: Path) -> str:
    """The Markdown of a page with its tables, and the numbers of its prose, as the results have them."""

    def figure(found: re.Match) -> str:
        if found[1] is None:
            raise ResultsError(f"{page.name}: '{found[4]}' stands behind no number; write ? before its mark")
        return value(found[4], found[3]) + found[2]

    text = BLOCK.sub(
        lambda m: f"{m[1]}<!-- results: {m[2]} -->\n{written(m[2], page, m[1])}{m[1]}<!-- end -->", text
    )
    return VALUE.sub(figure, text)


def loose_tables(text: str) -> list[str]:
    """First lines of tables that hold numbers, stand between no marks, and are not exempted."""
    lines = BLOCK.sub("", text).split("\n")
    found = []
    for k, line in enumerate(lines):
        before = lines[k - 1].strip() if k else ""
        if line.lstrip().startswith("|") and not before.startswith("|") and not EXEMPT.fullmatch(before):
            end = next((n for n in range(k, len(lines)) if not lines[n].lstrip().startswith("|")), len(lines))
            if any(re.search(r"\d", re.sub(r"`[^`]*`", "", row)) for row in lines[k:end]):
                found.append(line)
    return found


# ------------------------------------------------------------------------------------------------------------------
# Prose


def value(address: str, kind: str = "value") -> str:
    """The number at an address; with `mean`, `least` or `most`, of several rows. Raises `ResultsError`."""
    address = " ".join(address.split())
    over, ratio, under = (part.strip() for part in address.partition(" / "))
    try:
        parts, further = over.split("; "), under.split("; ")
        numbers = _numbers(parts)
        if ratio:
            divisors = _numbers(parts[: max(len(parts) - len(further), 0)] + further)
            if len(divisors) != len(numbers):
                raise ResultsError(f"{len(numbers)} rows over {len(divisors)}")
            numbers = [float(a) / float(b) if a and b else "" for a, b in zip(numbers, divisors, strict=True)]
        if kind == "value" and len(numbers) > 1:
            raise ResultsError(f"{len(numbers)} rows are '{parts[1]}'; name one, or write mean, least or most")
        numbers = [number for number in numbers if number != ""]
        if not numbers:
            raise ResultsError("the cell has no number")
    except ResultsError as error:
        raise ResultsError(f"'{address}': {error}") from None
    if kind == "mean":
        found = math.exp(sum(math.log(float(n)) for n in numbers) / len(numbers))
    else:
        found = max(numbers, key=float) if kind == "most" else min(numbers, key=float)
    return found if isinstance(found, str) else _short(found)


def _numbers(parts: list[str]) -> list[str]:
    """The number in each row that an address names; '' where a cell has none."""
    if len(parts) != 3:
        raise ResultsError("a figure is named by NAME; ROW; COLUMN")
    found = read(parts[0])
    lines, above = [], []
    for row in rows(found):
        above = [above[k] if cell == "" and above else str(cell) for k, cell in enumerate(row["cells"])]
        lines.append((above, row["cells"]))
    wanted = [_pattern(cell) for cell in parts[1].split("&")]
    chosen = [cells for names, cells in lines if _named(wanted, names)]
    if not chosen:
        known = ", ".join("&".join(map(_plain, names[:2])) for names, _ in lines)
        raise ResultsError(f"no row is '{parts[1]}'; rows: {known}")
    title, _, place = parts[2].partition("#")
    columns = [k for k, name in enumerate(found["columns"]) if _pattern(title).fullmatch(_plain(name))]
    if len(columns) != 1:
        known = ", ".join(filter(None, map(_plain, found["columns"])))
        raise ResultsError(f"{len(columns) or 'no'} column{'s are' if columns else ' is'} '{title}'; columns: {known}")
    return [_number(cells[columns[0]], place) for cells in chosen]


def _named(wanted: list[re.Pattern], names: list[str]) -> bool:
    return all(pattern.fullmatch(_plain(name)) for pattern, name in zip(wanted, names, strict=False))


def _number(cell, place: str) -> str:
    values = _values(cell) or ([cell] if re.fullmatch(r"-?[\d.]+", str(cell)) else [])
    if not values:
        return ""
    if (len(values) > 1 or place) and place not in map(str, range(1, len(values) + 1)):
        raise ResultsError(f"the cell has {len(values)} numbers; write #1 to #{len(values)} behind the column")
    return values[int(place or 1) - 1]


def _pattern(text: str) -> re.Pattern:
    return re.compile(".*".join(map(re.escape, _plain(text).split("*"))), re.S)


def _plain(text: str) -> str:
    return text.replace("`", "").strip()


def _short(number: float) -> str:
    text = f"{number:#.2g}"
    return (f"{float(text):.0f}" if "e+" in text else text).rstrip(".")


def loose_figures(text: str) -> list[str]:
    """Numbers in prose that look as if they were measured, but are written from no results, and are not exempted."""

    def left(found: re.Match) -> str:
        return "\n\n" if found[0].startswith(("\n", "    ", "```")) else ""

    text = NO_PROSE.sub(left, VALUE.sub("", BLOCK.sub("", text)))
    found, exempt = [], False
    for paragraph in re.split(r"\n\s*\n|\n(?=\s*- )", text):
        follows, exempt = exempt, bool(EXEMPT.search(" ".join(paragraph.split())))
        if not exempt and not follows:
            found += [" ".join(figure.split()) for figure in FIGURE.findall(paragraph)]
        exempt = EXEMPT.fullmatch(paragraph.strip()) is not None
    return found


# ------------------------------------------------------------------------------------------------------------------
# Age


@cache
def _git(root: Path, *words: str) -> str:
    try:
        done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()


def age(results: dict, root: Path) -> str:
    """A sentence on rows that are older than the code that they measure; '' where none is, or there is no history."""
    sources = rows(results) or [results]
    older, latest = 0, ""
    for row in sources:
        measured = _git(root, "log", "-1", "--format=%ct", row["commit"])
        changed = _git(root, "log", "-1", "--format=%ct %cs", "--", *row["paths"])
        if measured and changed and int(changed.split()[0]) > int(measured):
            older, latest = older + 1, max(latest, changed.split()[1])
    if not older:
        return ""
    what = "Older than the code that it measures" if older == len(sources) else (
        f"{older} of {len(sources)} rows are older than the code that they measure")  # fmt: skip
    return f"{what}, which was last changed {latest}."


def with_age(text: str, root: Path) -> str:
    """A page whose tables and figures say where they are older than their code, for `make docs` alone."""

    def added(found: re.Match) -> str:
        sentence = age(read(found[2]), root)
        note = f"\n{found[1]}*{sentence}*\n" if sentence else ""
        return f"{found[1]}<!-- results: {found[2]} -->\n{found[3]}{note}{found[1]}<!-- end -->"

    return BLOCK.sub(added, text)


def main() -> None:
    for page in pages():
        text = page.read_text(encoding="utf-8")
        new = rewritten(text, page)
        if new != text:
            page.write_text(new, encoding="utf-8")
            print(f"wrote {page.relative_to(ROOT)}")


if __name__ == "__main__":
    try:
        main()
    except ResultsError as error:
        sys.exit(str(error))
