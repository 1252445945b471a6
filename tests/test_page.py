"""The report's pictures in a real browser: all follow one, boxes choose, keys switch. Slow."""

import html
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from test_suite import row

from mi_neural.bench import page, repeats, report

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((found for name in BROWSERS if (found := shutil.which(name))), "")
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
           "--disable-background-networking", "--disable-component-update", "--virtual-time-budget=3000",
           "--dump-dom")  # fmt: skip

#: Moves the pointer as a user would, and leaves in the title what is to be seen then.
SCRIPT = """<script>
const root = document.getElementById("viewer-0"), all = [...root.querySelectorAll("figure")], seen = {};
const visible = () => all.map((f, k) => k).filter(k => !all[k].hidden);
const look = name => { seen[name] = {visible: visible(), shown: visible().map(k => all[k].querySelector("img").src),
                       moved: [...new Set(all.map(f => f.querySelector("img").style.transform))]}; };
const frame = all[3].querySelector(".frame"), box = frame.getBoundingClientRect();
frame.setPointerCapture = () => {};
const at = (x, y) => ({clientX: box.left + x * box.width, clientY: box.top + y * box.height, pointerId: 1});
const key = k => root.dispatchEvent(new KeyboardEvent("keydown", {key: k}));
const tick = text => [...root.querySelectorAll("label")].find(l => l.textContent.trim().startsWith(text)).click();
look("first");
for (let n = 0; n < 2; ++n) frame.dispatchEvent(new MouseEvent("dblclick", at(0.5, 0.5)));
look("zoomed");
frame.dispatchEvent(new PointerEvent("pointerdown", at(0.5, 0.5)));
frame.dispatchEvent(new PointerEvent("pointermove", at(2.5, 0.5)));
frame.dispatchEvent(new PointerEvent("pointerup", at(2.5, 0.5)));
look("dragged");
key("0"); key("e"); look("errors");
key("e"); tick("one-shot"); look("all");
tick("path"); look("without path"); tick("path");
tick("one at a time"); key("3"); look("third"); key("ArrowRight"); look("fourth");
document.title = JSON.stringify(seen);
</script></body>"""


def entry(value: int, integrator: str, kind: str) -> dict:
    urls = [page.data_url(np.full((8, 16, 3), v, np.uint8)) for v in (value, 255 - value)]
    return {"name": f"{integrator}, {kind}", "caption": "4 spp", "integrator": integrator, "kind": kind,
            "denoiser": "raw", "image": urls[0], "error": urls[1]}  # fmt: skip


#: Looks at a page in a frame of this width, and leaves in the title how wide it is, and how much of its tables and
#: plots can be scrolled to.
FRAME = """<body style="margin:0"><iframe width="%d" height="900" style="border:0"></iframe><script>
const frame = document.querySelector("iframe");
frame.onload = () => {
  const page = frame.contentDocument, parts = [...page.querySelectorAll(".wide, .curves")];
  const inside = parts.map(p => Math.max(...[...p.children].map(c => c.getBoundingClientRect().right)));
  document.title = JSON.stringify({
    width: page.documentElement.scrollWidth, of: page.documentElement.clientWidth, n: parts.length, cut: parts.filter(
    (p, k) => inside[k] > p.getBoundingClientRect().right + 1 && getComputedStyle(p).overflowX != "auto").length});
};
frame.srcdoc = %s;
</script></body>"""


def moved(seen: dict) -> list[float]:
    """(scale, x, y) of the transformation that all pictures have; positions of a pointer are whole pixels."""
    (transform,) = seen["moved"]
    return [float(number) for number in re.findall(r"-?[\d.]+", transform)]


def titled(tmp_path, text: str) -> dict:
    """What a page's script leaves in its title."""
    file = tmp_path / "page.html"
    file.write_text(text)
    command = [BROWSER, *OPTIONS, f"--user-data-dir={tmp_path / 'profile'}", file.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    return json.loads(html.unescape(re.search(r"<title>({.*?})</title>", done.stdout).group(1)))


needs_browser = pytest.mark.skipif(not BROWSER, reason="no Chromium to look at the page with: apt-get install chromium")


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("width", [400, 1400])
def test_page_is_as_wide_as_its_window(tmp_path, width):
    rows = [row(label=label, scene=name, mode=mode, budget_seconds=s, seconds_total=s, relmse_trimmed=0.1 / s, flip=0.1,
                spp=9) for name in ("a scene", "another") for mode in ("one-shot", "steady")
            for label in ("nirc_two_level:mode=progressive", "neural_path") for s in (1.0, 2.0)]  # fmt: skip
    black = page.data_url(np.zeros((9, 16, 3), np.uint8))
    entries = [{"name": "reference", "caption": "", "image": black, "error": None}, entry(9, "path", "steady 1 s")]
    scenes = []
    for name in ("a scene", "another"):
        own = [r for r in rows if r.scene == name]
        scenes.append(report.SceneResult(name, (16, 9), own, repeats.group(own), None, ["a note"], entries))
    found = report.Report("mi-neural compare " + "word " * 30, {"cpu": "x" * 60}, scenes)
    text = json.dumps(page.page(found, page.drawings(found))).replace("</", "<\\/")
    seen = titled(tmp_path, FRAME % (width, text))
    print(seen)
    assert width - 20 <= seen["width"] == seen["of"] and seen["n"] > 6 and seen["cut"] == 0


@pytest.mark.slow
@needs_browser
def test_pictures_are_zoomed_together_and_chosen(tmp_path):
    kinds = [("path", "one-shot 1 s"), ("nirc", "one-shot 1 s"), ("path", "steady 1 s"), ("nirc", "steady 1 s")]
    entries = [{"name": "reference", "caption": "", "image": page.data_url(np.zeros((8, 16, 3), np.uint8)),
                "error": None}, *(entry(40 * k, *kind) for k, kind in enumerate(kinds, 1))]  # fmt: skip
    scene = report.SceneResult("s", (16, 8), [], [], None, [], entries)
    seen = titled(tmp_path, page.page(report.Report("", {}, [scene]), {}).replace("</body>", SCRIPT))

    assert seen["first"]["visible"] == [0, 3, 4], "the reference, and the last kind of pictures"
    assert seen["first"]["shown"] == [entries[k]["image"] for k in (0, 3, 4)] and seen["first"]["moved"] == [""]
    assert moved(seen["zoomed"]) == pytest.approx([4, -37.5, -37.5], abs=0.5), "the middle stays where it is"
    assert moved(seen["dragged"]) == pytest.approx([4, 0, -37.5], abs=0.5), "no further than the edge"
    assert seen["errors"]["shown"] == [entries[0]["image"], entries[3]["error"], entries[4]["error"]]
    assert moved(seen["errors"]) == [1, 0, 0]
    assert seen["all"]["visible"] == [0, 1, 2, 3, 4] and seen["without path"]["visible"] == [0, 2, 4]
    assert seen["third"]["visible"] == [2] and seen["fourth"]["visible"] == [3]
