"""Tables and figures of README and manual are those of docs/results; none with measured numbers stands elsewhere."""

import re
import subprocess

import pytest


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
