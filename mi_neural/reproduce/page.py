"""One self-contained HTML page of an entry: the source's numbers beside ours, pictures, plots, tables."""

from __future__ import annotations

import base64
import html
import json
import re
from pathlib import Path

from mi_neural.bench import report
from mi_neural.bench.benchmark import plain
from mi_neural.bench.page import style
from mi_neural.image import exr

from .entry import WORDS, Entry, Outcome
from .work import Work

MORE_STYLE = """
section.text td { white-space: normal; text-align: left; vertical-align: top; max-width: 34rem }
section.text th { text-align: left }
tr.differs td:last-child { background: #fdf3e3 }
tr.agrees td:last-child { background: #e9f5ea }
img { max-width: 100% }
"""
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>{style}</style></head><body>
{body}
</body></html>
"""


def statement_cells(outcome: Outcome) -> list[list[str]]:
    """The table of statements as text, headings first."""
    lines = [[f"{s.paper} ({s.where})", s.ours, s.verdict] for s in outcome.statements]
    return [["the source", "here", "comparison"], *lines]


def write(entry: Entry, outcome: Outcome, work: Work, command: str, environment: dict[str, object]) -> Path:
    """Write `index.html`, `results.json` and the pictures as files into the entry's folder, and the index of all
    entries; returns the page."""
    folder = work.folder / entry.name
    folder.mkdir(parents=True, exist_ok=True)
    for title, data in outcome.pictures.items():
        exr.write_bytes(folder / f"{_slug(title)}.{_kind(data)}", data)
    results = {
        "entry": entry.name, "figure": entry.figure, "shows": entry.shows, "source": entry.source,
        "command": command, "quick": work.quick,
        "settings": work.settings, "environment": environment, "notes": outcome.notes, "tables": outcome.tables,
        "statements": [vars(s) | {"brief": s.brief, "verdict": s.verdict} for s in outcome.statements],
    }  # fmt: skip
    exr.write_text(folder / "results.json", json.dumps(plain(results), indent=1) + "\n")
    exr.write_text(folder / "index.html", page(entry, outcome, work, command, environment))
    write_index(work.folder)
    return folder / "index.html"


def write_index(folder: Path) -> Path:
    """Write `index.html` of all entries that have results below a folder; returns it."""
    lines = []
    for path in sorted(folder.glob("*/*/results.json")):
        try:
            lines.append(_index_line(json.loads(path.read_text(encoding="utf-8"))))
        except (KeyError, TypeError, ValueError):
            continue  # damaged, or of another version
    head = "<tr><th>name</th><th>counterpart of</th><th>what it shows</th><th>statements</th><th></th></tr>"
    title = "Figures of the sources, and here"
    body = f'<h1>{title}</h1>\n<section class="text"><table>{head}{"".join(lines)}</table></section>'
    exr.write_text(folder / "index.html", PAGE.format(title=title, style=style() + MORE_STYLE, body=body))
    return folder / "index.html"


def _index_line(found: dict) -> str:
    name, agree = html.escape(found["entry"]), [s["agrees"] for s in found["statements"]]
    counts = ", ".join(f"{agree.count(k)} {word}" for k, word in WORDS.items() if agree.count(k))
    texts = (found["figure"], found["shows"], counts, "quick" if found["quick"] else "")
    cells = [f'<a href="{name}/index.html">{name}</a>', *map(html.escape, texts)]
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def page(entry: Entry, outcome: Outcome, work: Work, command: str, environment: dict[str, object]) -> str:
    """The entry as one HTML document that loads nothing."""
    esc = html.escape
    settings = "\n".join(f"{k:20} {v}" for k, v in work.settings.items())
    around = "\n".join(f"{k:20} {v}" for k, v in environment.items())
    parts = [
        f"<h1>{esc(entry.name)}</h1>",
        f"<p>{esc(entry.shows)} Counterpart of {esc(entry.figure)} of {esc(entry.source)}. Scene: {esc(entry.scene)}."
        + (" Small, by --quick." if work.quick else "") + "</p>",
        "<h2>The source and here</h2>",
        f'<section class="text">{_statements(outcome)}</section>',
        "".join(f"<h2>{esc(title)}</h2>{_image(title, data)}" for title, data in outcome.pictures.items()),
        "".join(f'<h2>{esc(title)}</h2><div class="wide">{report.html_table(cells)}</div>'
                for title, cells in outcome.tables.items()),
        "<h2>What to know</h2><ul>" + "".join(f"<li>{esc(n)}</li>" for n in outcome.notes) + "</ul>"
        if outcome.notes else "",
        f"<h2>How this was made</h2><pre>{esc(command)}</pre><pre>{esc(settings)}</pre><pre>{esc(around)}</pre>",
    ]  # fmt: skip
    body = "\n".join(part for part in parts if part)
    return PAGE.format(title=esc(entry.name), style=style() + MORE_STYLE, body=body)


def _statements(outcome: Outcome) -> str:
    head, *lines = statement_cells(outcome)
    cells = ["<tr>" + "".join(f"<th>{html.escape(c)}</th>" for c in head) + "</tr>"]
    for statement, line in zip(outcome.statements, lines, strict=True):
        kind = {True: "agrees", False: "differs", None: "open"}[statement.agrees]
        cells.append(f'<tr class="{kind}">' + "".join(f"<td>{html.escape(c)}</td>" for c in line) + "</tr>")
    return f"<table>{''.join(cells)}</table>"


def _image(title: str, data: bytes) -> str:
    text = base64.b64encode(data).decode()
    return f'<p><img alt="{html.escape(title)}" src="data:image/{_kind(data)};base64,{text}"></p>'


def _kind(data: bytes) -> str:
    return "png" if data.startswith(b"\x89PNG") else "jpeg"


def _slug(title: str) -> str:
    return re.sub(r"[^\w]+", "_", title.lower()).strip("_")
