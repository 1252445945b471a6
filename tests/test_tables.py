"""Tables and figures of README and manual are those of docs/results; none with measured numbers stands elsewhere."""

import re
import subprocess

import pytest
from markdown_it import MarkdownIt


@pytest.fixture(scope="module")
def tables(docs_script):
    return docs_script("tables")


def test_pages_are_as_the_results_have_them(tables):
    for page in tables.pages():
        text = page.read_text(encoding="utf-8")
        assert tables.rewritten(text, page) == text, f"{page.name}: type: make tables"


def test_no_measured_table_stands_outside_of_the_marks(tables):
    for page in tables.pages():
        assert not tables.loose_tables(page.read_text(encoding="utf-8")), page.name


def test_no_measured_figure_stands_in_prose(tables):
    """Settings are written as code (`0.03`), figures of others after `<!-- no results: REASON -->`."""
    found = {page.name: tables.loose_figures(page.read_text(encoding="utf-8")) for page in tables.pages()}
    assert not {name: figures for name, figures in found.items() if figures}


def test_every_picture_of_a_page_is_a_result(tables):
    for page in tables.pages():
        assert "](" not in re.sub(r"(?<!!)\[[^\]]*\]\(", "", tables.BLOCK.sub("", page.read_text(encoding="utf-8")))


def test_every_result_is_shown_and_says_where_it_comes_from(tables, root):
    shown = {name for page in tables.pages() for _, name, _ in tables.BLOCK.findall(page.read_text(encoding="utf-8"))}
    files = {file.stem for file in tables.RESULTS.glob("*.json")}
    assert shown == files
    for name in files:
        found = tables.read(name)
        assert tables.encoded(found) == (tables.RESULTS / f"{name}.json").read_text(encoding="utf-8"), name
        for source in tables.rows(found) or [found]:
            assert re.fullmatch(r"[0-9a-f]{7,40}", source["commit"]), name
            assert re.fullmatch(r"20\d\d-\d\d-\d\d", source["date"]) and source["machine"] and source["mitsuba"], name
            assert source["paths"] and all((root / path).exists() for path in source["paths"]), name
        if "figure" in found:
            assert (root / found["figure"]).is_file()


def test_commits_of_results_exist(tables, root):
    if not (root / ".git").exists():
        pytest.skip("no history: this is no checkout")
    commits = {s["commit"] for f in tables.RESULTS.glob("*.json") for s in
               (tables.rows(tables.read(f.stem)) or [tables.read(f.stem)])}  # fmt: skip
    shallow = subprocess.run(["git", "rev-parse", "--is-shallow-repository"], cwd=root, capture_output=True, text=True)
    if shallow.stdout.strip() == "true":
        pytest.skip("a shallow clone lacks the commits of old rows")
    for commit in commits:
        assert subprocess.run(["git", "cat-file", "-e", f"{commit}^{{commit}}"], cwd=root).returncode == 0, commit


# ---------------------------------------------------------------- on results of the tests' own


SOURCE = '''"commit": "abcdef0", "date": "2026-01-02", "machine": "one core", "mitsuba": "3.9.1", "command": "make x",
 "paths": ["a"]'''


@pytest.fixture
def own(tables, tmp_path, monkeypatch):
    """`own(columns, rows, more)` writes results `mine` and returns what a page shows of them."""
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    monkeypatch.setattr(tables, "RESULTS", tmp_path)

    def write(columns: str, rows: str, more: str = "") -> str:
        text = f'{{"title": "Mine.", {SOURCE}, "columns": {columns}, {more} "rows": {rows}}}'
        (tmp_path / "mine.json").write_text(text, encoding="utf-8")
        return tables.rewritten("  <!-- results: mine -->\n  | old |\n  <!-- end -->", tmp_path / "page.md")

    return write


def test_digits_formats_best_and_indents(own):
    text = own('["", "a", "b"]', '[["x", [0.10, 2e-05], {"values": [0.20, 2e-05], "as": "{} / {} (c)"}], ["y", 3, ""]]',
               '"formats": {"2": "{} / {}"}, "best": [1, 2],')  # fmt: skip
    lines = [line.removeprefix("  ") for line in text.split("\n")]
    assert lines[1:5] == ["| | a | b |", "|---|---|---|", "| x | **0.10** / **2e-05** | 0.20 / **2e-05** (c) |",
                          "| y | **3** | |"]  # fmt: skip
    assert "Made 2026-01-02 (abcdef0), one core, Mitsuba 3.9.1, by `make x`." in " ".join(lines)
    assert own('["a"]', '[[1]]', '"best_values": 0, "best": [0],').split("\n")[3] == "  | 1 |"


def test_a_changed_number_is_noticed(own, tables, tmp_path):
    text = own('["a"]', "[[1.50]]")
    page = tmp_path / "page.md"
    assert tables.rewritten(text, page) == text and tables.rewritten(text.replace("1.50", "1.5"), page) == text
    assert text.replace("1.50", "1.5") != text


def test_rows_name_the_versions_that_they_are_of(own):
    rows = '[[1], {"cells": [2], "commit": "1234567", "date": "2025-12-31"}]'
    assert "Made 2025-12-31 to 2026-01-02 (abcdef0, 1234567)" in own('["a"]', rows).replace("\n  ", " ")


def test_mistakes_are_refused_by_name(own, tables, tmp_path):
    with pytest.raises(tables.ResultsError, match=r"there are no results 'mine'; write mine\.json"):
        tables.read("mine")
    with pytest.raises(tables.ResultsError, match="2 columns, but a row of 1: x"):
        own('["a", "b"]', '[["x"]]')
    (tmp_path / "mine.json").write_text('{"title": "", "columns": [], "commit": "a"}', encoding="utf-8")
    with pytest.raises(tables.ResultsError, match="says nothing of: date, machine"):
        tables.read("mine")


def test_loose_tables_are_found(tables):
    table = "| a |\n|---|\n| 0.5 |\n"
    assert tables.loose_tables(f"text\n\n{table}") == ["| a |"]
    assert not tables.loose_tables(f"<!-- results: x -->\n{table}<!-- end -->")
    assert not tables.loose_tables(f"<!-- no results: defaults -->\n{table}")
    assert tables.loose_tables(f"<!-- no results -->\n{table}"), "a reason is needed"
    assert not tables.loose_tables("| a |\n|---|\n| `path2` |\n"), "numbers in names do not count"


COLUMNS = '["", "", "`path`", "`nrc`, c = 1", "ms: query"]'
ROWS = """[["door", "frame of 1 s", [0.50, 0.10], [0.30, 0.05], 4], ["", "shot", [0.20, 0.20], [0.05, 0.20], 130],
    ["lamp", "frame of 1 s", 4, "", "4 ms"], ["two lamps", "shot", 0.8, 0.2, "0.40"]]"""


def value(own, tables, address: str, kind: str = "value") -> str:
    own(COLUMNS, ROWS, '"formats": {"2": "{} / {}"},')
    text = tables.rewritten(f"It is 9.9<!-- {kind}: {address} -->, less.", tables.ROOT / "page.md")
    assert text.endswith(f"<!-- {kind}: {address} -->, less.")
    return text.removeprefix("It is ").partition("<!--")[0]


@pytest.mark.parametrize(
    "address, figure",
    [
        ("mine; two lamps; path", "0.8"),
        ("mine; door&shot; ms: query", "130"),
        ("mine; door&frame of 1 s; path#1", "0.50"),
        ("mine; two*; path", "0.8"),
        ("mine; two lamps; ms*", "0.40"),
        ("mine; door&shot;\n  nrc*#2", "0.20"),
        ("mine; door&shot; nrc*#1 / path#1", "0.25"),
        ("mine; door&shot; ms* / door&frame*; ms*", "32"),
        ("mine; door&shot; ms* / mine; two lamps; ms*", "320"),
    ],
)
def test_figures_in_prose_are_written_from_results(own, tables, address, figure):
    """Cells with their digits; ratios with two."""
    assert value(own, tables, address) == figure


def test_figures_of_several_rows(own, tables):
    """Their least, their most, and their geometric mean; rows without a number are left out."""
    assert value(own, tables, "mine; door; nrc*#1 / path#1", "least") == "0.25"
    assert value(own, tables, "mine; door; nrc*#1 / path#1", "most") == "0.60"
    assert value(own, tables, "mine; door; nrc*#1 / path#1", "mean") == "0.39"
    assert value(own, tables, "mine; door; nrc*#2", "least") == "0.05"
    assert value(own, tables, "mine; *&shot; ms*", "mean") == "7.2"
    assert value(own, tables, "mine; *lamp*; nrc* / path", "most") == "0.25"


@pytest.mark.parametrize(
    "address, error",
    [
        ("mine; door", r"'mine; door': a figure is named by NAME; ROW; COLUMN"),
        ("yours; door; path", "there are no results 'yours'"),
        ("mine; hall; path", r"'mine; hall; path': no row is 'hall'; rows: door&frame of 1 s,"),
        ("mine; door; nirc", r"no column is 'nirc'; columns: path, nrc, c = 1, ms: query"),
        ("mine; door&shot; *", "5 columns are"),
        ("mine; door&shot; path#3", "the cell has 2 numbers"),
        ("mine; door&shot; path#x", "the cell has 2 numbers"),
        ("mine; door&shot; path", "the cell has 2 numbers"),
        ("mine; door; path#1", "2 rows are 'door'; name one, or write mean, least or most"),
        ("mine; lamp; nrc*", "the cell has no number"),
        ("mine; lamp; ms*", "the cell has no number"),
    ],
)
def test_figures_that_are_not_there_are_refused_by_name(own, tables, address, error):
    with pytest.raises(tables.ResultsError, match=error):
        value(own, tables, address)


def test_a_mark_behind_no_figure_is_refused(own, tables):
    own('["", "a"]', '[["x", 1]]')
    page = tables.ROOT / "page.md"
    assert tables.rewritten("-0.5<!-- value: mine; x; a --> 0-2.e<!-- x -->", page).startswith("1<!--")
    assert tables.rewritten("1 to 2e-05<!-- value: mine; x; a -->", page).startswith("1 to 1<!--")
    with pytest.raises(tables.ResultsError, match=r"page\.md: 'mine; x; a' stands behind no number"):
        tables.rewritten("about <!-- value: mine; x; a -->", page)


def test_a_mark_may_be_broken_at_every_space(tables):
    """No line of it begins a list or a quotation, whichever way an editor wraps the paragraph."""
    marks = {m[0] for page in tables.pages() for m in tables.VALUE.finditer(page.read_text(encoding="utf-8"))}
    for mark in {*marks, "1.5<!-- most: mine; *&shot; nrc*#1 / *; path#1 -->"}:
        text = "\n".join(f"It has {mark}, less.".split())
        html = MarkdownIt().render(text)
        assert html.startswith("<p>It\nhas\n") and html.count("<") == 3 and html.endswith("less.</p>\n"), mark
        assert tables.VALUE.sub("", text) == "It\nhas\n,\nless."


@pytest.mark.parametrize(
    "text, figures",
    [
        ("The error is 0.48 there.", ["0.48"]),
        ("less by 13 %, or 5%", ["13 %", "5%"]),
        ("from -0.5 to -10 %, 1/2.8, 2-3 %", ["-0.5", "-10 %", "2.8", "3 %"]),
        ("it takes 12 ms, 3 s and\n40 MiB, 5 times as much", ["12 ms", "3 s", "40 MiB", "5 times"]),
        ("- one .0022\n- two 2e-05", [".0022", "2e-05"]),
        ("0.48<!-- value: a; b; c -->", []),
        ("`rate=0.03`, Mitsuba 3.9.1, version 0.2, 32 lamps, 640x360, (0.5", ["0.5"]),
        ("    mi-neural --seconds 0.5 5 %\n\n```python\nx = 0.5\n```\n\n1.5", ["1.5"]),
        ("frames of 0.25 s and a shot of 10 s", []),
        ("<!-- no results: the paper's -->\n0.48\nand 0.49\n\n0.50", ["0.50"]),
        ("- 0.48 <!-- no results: the paper's -->\n  and 0.49\n- 0.50", ["0.50"]),
        ("0.48 `a`\n<!-- no results: of\nthe paper --> 0.49 `b` 0.5", []),
        ("- 0.48\n  <!-- no results: x -->\n\n  0.49", ["0.49"]),
        ("<!-- results: x -->\n| 0.5 |\n<!-- end -->\n[doi](https://doi.org/10.1/3.4) e70050", []),
    ],
)
def test_loose_figures_are_found(tables, text, figures):
    assert tables.loose_figures(text) == figures


def test_rows_older_than_their_code_are_named(tables, tmp_path):
    def git(*words, when="2026-01-01"):
        env = {f"GIT_{who}_{what}": value for who in ("AUTHOR", "COMMITTER")
               for what, value in (("NAME", "x"), ("EMAIL", "x@x"), ("DATE", f"{when}T12:00:00Z"))}  # fmt: skip
        done = subprocess.run(["git", *words], cwd=tmp_path, env=env | {"PATH": "/usr/bin:/bin"}, capture_output=True,
                              text=True, check=True)  # fmt: skip
        return done.stdout.strip()

    def commit(file, when):
        (tmp_path / file).write_text(when)
        git("add", file), git("commit", "-q", "-m", file, when=when)
        return git("rev-parse", "--short", "HEAD")

    git("init", "-q")
    first, second = commit("a", "2026-01-01"), commit("b", "2026-01-02")
    source = {"date": "2026-01-01", "machine": "", "mitsuba": "", "command": None, "title": "", "columns": [""]}
    aged = {**source, "commit": first, "paths": ["a", "b"], "rows": [["x"], {"cells": ["y"], "commit": second}]}
    assert tables.age(aged, tmp_path).startswith("1 of 2 rows are older") and "2026-01-02" in tables.age(aged, tmp_path)
    assert tables.age({**aged, "rows": [["x"]]}, tmp_path).startswith("Older than the code")
    assert tables.age({**aged, "paths": ["a"]}, tmp_path) == ""
    outside = tmp_path / "no" / "history"
    assert tables.age({**aged, "commit": "0000000"}, outside) == ""
