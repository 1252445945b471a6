"""`mi-neural reproduce`: the list, unknown names, going on after an interruption, pages with both numbers."""

import html
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from mi_neural.cli import app
from mi_neural.reproduce import registry, reliability
from mi_neural.reproduce.entry import SOURCES, Entry, Outcome, Statement
from mi_neural.reproduce.work import Part, Work


def run(*words: str):
    return CliRunner().invoke(app, ["reproduce", *words])


def test_list_names_every_entry_with_its_source():
    shown = run()
    assert shown.exit_code == 0
    for name, entry in registry.ENTRIES.items():
        assert name.partition("/")[0] in SOURCES and entry.source
        (line,) = [line for line in shown.stdout.splitlines() if line.startswith(f"{name} ")]
        assert entry.figure in line and entry.scene in line and entry.shows in line


def test_unknown_name_is_one_line_with_close_ones(tmp_path):
    shown = run("reliability/figure4", "-o", str(tmp_path / "none"))
    assert shown.exit_code == 2
    assert "there is no entry 'reliability/figure4'" in shown.stderr and "reliability/fig4" in shown.stderr
    assert not (tmp_path / "none").exists()


def test_a_source_stands_for_all_its_entries():
    expected = [name for name in registry.ENTRIES if name.startswith("reliability/")]
    assert len(expected) > 1 and [e.name for e in registry.find("reliability")] == expected


def test_interrupted_entry_goes_on_without_measuring_again(tmp_path, monkeypatch):
    measured = []

    def first(bar) -> Part:
        measured.append("first")
        return Part({"error": np.float32(0.25)}, {"image": np.full((2, 3), 7.0)})

    def second(bar) -> Part:
        measured.append("second")
        if len(measured) == 2:
            raise KeyboardInterrupt
        return Part({"error": 0.5})

    def measure(work: Work) -> Outcome:
        group = work.group("fake", {"size": work.size})
        parts = [group.part("first", first), group.part("second", second)]
        assert parts[0].arrays["image"].sum() == 42.0
        text = ", ".join(str(p.numbers["error"]) for p in parts)
        return Outcome([Statement("error 0.3", "table 9", text, False, "-17 %", "another scene")], notes=["<a note>"])

    entry = Entry("fsr/fake", "Table 9", "Two parts.", "none", (1, 1), measure)
    monkeypatch.setattr(registry, "ENTRIES", {entry.name: entry})
    stopped = run("fsr/fake", "-o", str(tmp_path))
    assert stopped.exit_code == 130 and "goes on from here" in stopped.stderr
    assert run("fsr/fake", "-o", str(tmp_path)).exit_code == 0
    assert measured == ["first", "second", "second"]
    page = (tmp_path / "fsr/fake/index.html").read_text()
    shown = ("error 0.3", "table 9", "0.25, 0.5", "differs, -17 %: another scene", "&lt;a note&gt;")
    assert all(text in page for text in shown)

    assert run("fsr/fake", "-o", str(tmp_path), "--size", "8x8").exit_code == 0
    assert measured[3:] == ["first", "second"], "another size is another measurement"


def test_damaged_part_is_measured_again(tmp_path):
    group = Work(tmp_path).group("fake", {})
    (group.folder / "part.json").write_text('{"error": 0.')
    assert group.part("part", lambda bar: Part({"error": 1.0})).numbers == {"error": 1.0}
    assert json.loads((group.folder / "part.json").read_text()) == {"error": 1.0}


@pytest.mark.parametrize("agrees, word", [(True, "agrees"), (False, "differs: why"), (None, "not comparable: why")])
def test_reason_is_shown_where_numbers_differ(agrees, word):
    assert Statement("a", "b", "c", agrees, "", "why").verdict == word


def test_quick_counterpart_shows_both_numbers(tmp_path, monkeypatch):
    tiny = reliability.Settings((16, 16), frames=23, pretrain=2, spp=1, reference_spp=16, cache_samples=1,
                                methods=("High-LR", "EMA", "blend"))  # fmt: skip
    monkeypatch.setattr(reliability, "QUICK", tiny)
    for name in ("fig1", "fig4"):
        shown = run(f"reliability/{name}", "--quick", "-o", str(tmp_path))
        assert shown.exit_code == 0, shown.stderr
        folder = tmp_path / "reliability" / name
        found = json.loads((folder / "results.json").read_text())
        page = (folder / "index.html").read_text()
        for s in found["statements"]:
            assert all(html.escape(s[key]) in page for key in ("paper", "where", "ours", "verdict"))
    assert "training" not in shown.stderr, "the second figure takes the first one's frames"
    found = json.loads((tmp_path / "reliability/fig4/results.json").read_text())
    flip = {line[0]: [float(v) for v in line[1:4]] for line in found["tables"]["Means over the frames"][1:]}
    assert all(before < after for before, after, _ in flip.values()), "a moved lamp makes every cache wrong"
