"""The report of a comparison: what it opens with, what it marks, and its size."""

import base64
import io
import re

import numpy as np
from PIL import Image
from test_suite import row

from mi_neural.bench import page, repeats, report


def test_a_scene_opens_with_pictures_and_error_over_time_and_marks_the_best():
    rows = [row(label=label, budget_seconds=s, seconds_total=s, relmse_trimmed=e, flip=f, spp=n)
            for label, s, e, f, n in (("path", 1.0, 0.4, 0.1, 9), ("path", 2.0, 0.2, 0.1, 20),
                                      ("nirc", 1.0, 0.1, 0.2, 7), ("nirc", 2.0, 0.3, 0.05, 8))]  # fmt: skip
    black = page.data_url(np.zeros((4, 4, 3), np.uint8))
    entries = [{"name": "reference", "caption": "", "image": black, "error": None}]
    scene = report.SceneResult("a", (4, 4), rows, repeats.group(rows), None, ["a note"], entries)
    found = report.Report("", {}, [scene])
    text = page.page(found, page.drawings(found))
    order = [text.index(part) for part in ('id="viewer-0"', "Error over time", "a note", "<table", "over their budget")]
    assert order == sorted(order) and text.index("<svg") < text.index("<table")
    head = report.table(scene.groups)[0]
    marked = {(line, head[column]) for line, column in report.best(scene.groups)}
    assert marked == {(1, "spp"), (2, "spp"), (3, "relMSE trimmed"), (2, "relMSE trimmed"), (1, "FLIP"), (4, "FLIP")}
    assert text.count('<td class="best">') == len(marked)


def test_several_scenes_open_with_the_first_and_end_with_a_summary():
    scenes = []
    for name in "ab":
        rows = [row(label=label, scene=name, budget_seconds=1.0, seconds_total=1.0, relmse_trimmed=0.1, flip=0.1, spp=9)
                for label in ("path", "nirc")]  # fmt: skip
        entries = [{"name": "reference", "caption": "", "image": "", "error": None}]
        scenes.append(report.SceneResult(name, (4, 4), rows, repeats.group(rows), None, [], entries))
    text = page.page(report.Report("", {}, scenes), {})
    order = [text.index(part) for part in ("<nav>", 'id="viewer-0"', 'id="viewer-1"', 'id="summary"', 'id="made"')]
    assert order == sorted(order)
    links = re.findall(r'<a href="#(.*?)"', text)
    assert links == ["scene-0", "scene-1", "summary", "made"] and all(f'id="{at}"' in text for at in links)


def test_best_of_a_summary_is_the_least_error_and_the_largest_factor():
    cells = [["integrator", "a", "factor"], ["path", "0.4 / 0.1", "1"], ["nirc", "0.1 / 0.2", "4"],
             ["nrc", " / 0.1", ""]]  # fmt: skip
    assert report.best_of_summary(cells) == {(2, 1), (2, 2)}
    assert report.best_of_summary(cells[:2]) == set(), "one line has no best"


def test_a_page_of_three_scenes_stays_below_8_mb(rng):
    """The worst case: pictures of nothing but noise, 20 kinds of them with their error maps."""
    rgb8 = rng.integers(0, 256, (360, 640, 3)).astype(np.uint8)
    url = page.data_url(rgb8, page.picture_bytes(20))
    entries = [{"name": "reference", "caption": "", "image": url, "error": None}]
    entries += [{"name": str(k), "caption": "", "image": url, "error": url} for k in range(20)]
    rows = [row(label=k, mode=mode, budget_seconds=s, seconds_total=s, relmse_trimmed=0.1 / s, flip=0.1, spp=10 * s)
            for k in "abcde" for mode in ("one-shot", "curve", "steady") for s in (0.1, 0.5, 2.0, 10.0)]  # fmt: skip
    scenes = [report.SceneResult(name, (640, 360), rows, repeats.group(rows), None, [], entries) for name in "xyz"]
    found, drawn = report.Report("", {}, scenes), page.curves_of(scenes[0])  # all scenes have the same rows
    drawings = {(scene.name, kind): svg for scene in scenes for kind, svg in drawn.items()}
    size = len(page.page(found, drawings).encode())
    print(f"{size / 1e6:.2f} MB, a picture {0.75e-3 * len(url):.1f} kB")
    assert 4e6 < size < 8e6


def test_pictures_are_exact_where_that_is_small(rng):
    smooth = np.tile(np.arange(64, dtype=np.uint8)[None, :, None], (64, 1, 3))
    bytes_ = base64.b64decode(page.data_url(smooth, 10**4).partition(",")[2])
    assert (np.array(Image.open(io.BytesIO(bytes_))) == smooth).all()
    noise = rng.integers(0, 256, (256, 256, 3)).astype(np.uint8)
    small = base64.b64decode(page.data_url(noise, 8000).partition(",")[2])
    assert len(small) <= 8000 and Image.open(io.BytesIO(small)).size == (128, 128)
