"""Measure tables of README and manual again: `python docs/results.py`, or `make results`.

Runs the command of each table whose file says how to read it (`extract`), writes its numbers into `docs/results`, and
the tables into the Markdown. Of other tables it prints the command. `$OUT` in a command is a folder in `out/results`,
public scenes are those of `mi-neural scenes`. Interrupted, it goes on from there when typed again:
what was measured of a version is not measured again.

`extract` names the groups of the `results.json` that `mi-neural compare` writes. A cell is the group that has all that
its row and its column say (`rows`, `columns`: null for one that stays as it is), for example `scene`, `label`, `mode`,
`budget_seconds`, `denoised`. `values` are the fields to show and how many digits they have (a text is shown as it is);
`as` is how the cell is written, where `formats` of the table does not say it; `title` renames a column. Where `needs`
is `gpu`, the table is measured on machines with an NVIDIA GPU only.

Other programs write other files. `file` is then a pattern of their names in `$OUT`, and `records` the list in such a
file whose elements take the place of groups (`.`: the whole file is one). A record has the fields of its file beside
its own; a field inside of a field is written with a dot (`efficiency.colours`). `each` lists the further fields of the
records that together make one cell. `commands` are run where one command does not measure all rows. With `fields` in
place of `rows` and `columns` each record is a row of these fields; the first one stands only where it changes.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import tables
from tables import ROOT, Number, ResultsError

from mi_neural.scenes import public

OUT = ROOT / "out/results"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", metavar="NAME", help="one table")
    parser.add_argument("--machine", metavar="TEXT", help="what the captions say of this machine")
    asked = parser.parse_args(arguments)
    names = [asked.only] if asked.only else sorted(file.stem for file in tables.RESULTS.glob("*.json"))
    for name in names:
        found = tables.read(name)
        if why := not_run(found):
            print(f"{name}: {why}: {found['command'] or 'no command'}")
            continue
        measured = run(found)
        fill(found, measured, version(found["paths"]), asked.machine)
        (tables.RESULTS / f"{name}.json").write_text(tables.encoded(found), encoding="utf-8")
        print(f"{name}: measured")
    tables.main()


def not_run(found: dict) -> str:
    """Why a table is not measured here; '' where it is."""
    if not found["command"]:
        return "its script was not kept"
    if "extract" not in found:
        return "nothing reads its numbers yet; type by hand"
    if found["extract"].get("needs") == "gpu" and not has_gpu():
        return "needs an NVIDIA GPU; type on a machine that has one"
    commands = found["extract"].get("commands", [found["command"]])
    named = [word for command in commands for word in shlex.split(command) if word in public.names()]
    needed = dict.fromkeys(name.partition("/")[0] for name in named if not public.file(name).is_file())
    return f"needs public scenes; type mi-neural scenes get {' '.join(needed)}" if needed else ""


def has_gpu() -> bool:
    """Whether Dr.Jit finds a CUDA device here."""
    import drjit as dr

    return dr.has_backend(dr.JitBackend.CUDA)


def version(paths: list[str]) -> str:
    """The commit that is measured. Raises `ResultsError` where the code has changes that no commit has."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    if changed := git("status", "--porcelain", "--", *paths):
        raise ResultsError(f"numbers belong to a commit, but this code was changed; commit or stash first:\n{changed}")
    return git("rev-parse", "--short", "HEAD")


def run(found: dict) -> dict:
    """What the commands of a table measure; tables of the same commands share one run."""
    extract = found.get("extract", {})
    commit, commands = version(found["paths"]), extract.get("commands", [found["command"]])
    out = OUT / hashlib.sha256(f"{commit} {' && '.join(commands)}".encode()).hexdigest()[:12]
    for k, command in enumerate(commands):
        done = out / ("done" if k == len(commands) - 1 else f"done_{k}")
        if not done.exists():
            out.mkdir(parents=True, exist_ok=True)
            _run(command, out)
            done.write_text(f"{commit}\n{command}\n", encoding="utf-8")
    if "file" in extract or "records" in extract:
        return collected(out, extract.get("file", "results.json"), extract.get("records", "groups"))
    return json.loads((out / "results.json").read_text(encoding="utf-8"))


def _run(command: str, out: Path) -> None:
    """One command, with `$OUT` as it is here. Raises `ResultsError` where it fails."""
    words = [word.replace("$OUT", str(out)) for word in shlex.split(command)]
    print("running:", shlex.join(words), flush=True)
    if words[0] == "mi-neural":  # of this environment
        program = Path(sys.executable).with_name("mi-neural")
        words[:1] = [str(program)] if program.exists() else [sys.executable, "-m", "mi_neural"]
    elif words[0] == "python":
        words[0] = sys.executable
    status = subprocess.run(words, cwd=ROOT, env={**os.environ, "PYTHONSAFEPATH": "1"}).returncode
    if status:
        raise ResultsError(f"the command ended with status {status}; type the same again to go on from there")


def collected(out: Path, pattern: str, records: str) -> dict:
    """The records of all files of this name in `out`, as the groups of a comparison, and the last file's environment.

    Raises `ResultsError` where no such file was written, or one has no such list.
    """
    groups, environment = [], {}
    for file in sorted(out.glob(pattern)):
        data = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(found := [data] if records == "." else data.get(records), list):
            raise ResultsError(f"{file.name} has no list '{records}'")
        common = {key: value for key, value in data.items() if not isinstance(value, (dict, list))}
        groups += [{**common, **_flat(record)} for record in found]
        environment = data["environment"]
    if not groups:
        raise ResultsError(f"the command wrote no records: there is no {pattern} in {out}")
    return {"groups": groups, "environment": environment}


def _flat(record: dict, before: str = "") -> dict:
    """The record with what is inside of its fields under names with a dot; lists are left out."""
    flat = {}
    for key, value in record.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{before}{key}.")
        elif not isinstance(value, list):
            flat[before + key] = value
    return flat


def fill(found: dict, measured: dict, commit: str, machine: str | None) -> None:
    """Put the numbers of `measured` into the table `found`, with their version, date and machine.

    A row that is not measured keeps its own.
    """
    extract, before = found["extract"], tables.rows(found)
    where = measured["environment"]
    machine = machine or where.get("machine") or f"{where['cores']} cores ({where['cpu']})"
    today = datetime.date.today().isoformat()
    made = {"commit": commit, "date": today, "mitsuba": where["mitsuba"], "machine": machine}
    if "fields" in extract:
        found.update(made, rows=rows_of(measured["groups"], extract["fields"]))
        return
    cells = [list(row["cells"]) for row in before]
    for k, column in enumerate(extract["columns"]):
        if column is None:
            continue
        found["columns"][k] = column.get("title", found["columns"][k])
        for line, row in zip(cells, extract["rows"], strict=True):
            if row is not None:
                line[k] = cell({**extract, **column, **row}, measured["groups"])
    found.update(made)
    kept = [{key: row[key] for key in tables.SOURCE if row[key] != found[key]} for row in before]
    found["rows"] = [line if row is not None or not source else {"cells": line, **source}
                     for line, row, source in zip(cells, extract["rows"], kept, strict=True)]  # fmt: skip


def rows_of(records: list[dict], fields: list[str]) -> list[list[str]]:
    """Each record's `fields`, texts, as a row; the first is left out where it is that of the row above."""
    rows = [[str(record[name]) for name in fields] for record in records]
    return [["" if k and rows[k - 1][0] == row[0] else row[0], *row[1:]] for k, row in enumerate(rows)]


#: What of `extract` says nothing about which group is meant.
SETTINGS = ("rows", "columns", "values", "as", "title", "file", "records", "commands", "each", "needs")
#: What messages name first.
FIRST = ("scene", "label", "mode", "budget_seconds", "denoised")


def cell(wanted: dict, groups: list[dict]) -> object:
    """The numbers of the one group that has all that `wanted` says (with `each`: of several); '' where it has none."""
    numbers = []
    for further in wanted.get("each", [{}]):
        both = {**dict.fromkeys(FIRST), **wanted, **further}
        fields = {key: value for key, value in both.items() if key not in SETTINGS and value is not None}
        found = [g for g in groups if all(key in g and _same(g[key], value) for key, value in fields.items())]
        if len(found) != 1:
            shown = ", ".join(f"{key} {value}" for key, value in fields.items())
            raise ResultsError(f"{len(found)} groups of the comparison have {shown}; there must be one")
        if unknown := [name for name in wanted["values"] if not any(name in g for g in groups)]:
            raise ResultsError(f"no group of the comparison has a field {', '.join(unknown)}")
        numbers += [_digits(found[0].get(name), digits) for name, digits in wanted["values"].items()]
    if any(number is None for number in numbers):
        return ""
    if "as" in wanted:
        return {"values": numbers, "as": wanted["as"]}
    return numbers if len(numbers) > 1 else numbers[0]


def _same(value, wanted) -> bool:
    return float(value) == float(wanted) if isinstance(wanted, Number) else value == wanted


def _digits(value: float | str | None, digits: str) -> Number | str | None:
    """A number with so many digits: `3g` or `.3f`, as in a format string; a text as it is."""
    if value is None or isinstance(value, str):
        return value
    text = format(value, digits if "." in digits else f".{digits}")
    text = text if float(text) else text.removeprefix("-")
    return Number(f"{float(text):.0f}" if "e+" in text else text)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    try:
        main()
    except ResultsError as error:
        sys.exit(str(error))
