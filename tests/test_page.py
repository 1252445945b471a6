"""The report's pictures in a real browser: all follow one, boxes choose, keys switch. Slow."""

import html
import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from mi_neural.bench import page, report

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


def moved(seen: dict) -> list[float]:
    """(scale, x, y) of the transformation that all pictures have; positions of a pointer are whole pixels."""
    (transform,) = seen["moved"]
    return [float(number) for number in re.findall(r"-?[\d.]+", transform)]


@pytest.mark.slow
def test_pictures_are_zoomed_together_and_chosen(tmp_path):
    if not BROWSER:
        pytest.skip("no Chromium to look at the page with: apt-get install chromium")
    kinds = [("path", "one-shot 1 s"), ("nirc", "one-shot 1 s"), ("path", "steady 1 s"), ("nirc", "steady 1 s")]
    entries = [{"name": "reference", "caption": "", "image": page.data_url(np.zeros((8, 16, 3), np.uint8)),
                "error": None}, *(entry(40 * k, *kind) for k, kind in enumerate(kinds, 1))]  # fmt: skip
    scene = report.SceneResult("s", (16, 8), [], [], None, [], entries)
    file = tmp_path / "page.html"
    file.write_text(page.page(report.Report("", {}, [scene]), {}).replace("</body>", SCRIPT))
    command = [BROWSER, *OPTIONS, f"--user-data-dir={tmp_path / 'profile'}", file.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    seen = json.loads(html.unescape(re.search(r"<title>(.*?)</title>", done.stdout).group(1)))

    assert seen["first"]["visible"] == [0, 3, 4], "the reference, and the last kind of pictures"
    assert seen["first"]["shown"] == [entries[k]["image"] for k in (0, 3, 4)] and seen["first"]["moved"] == [""]
    assert moved(seen["zoomed"]) == pytest.approx([4, -37.5, -37.5], abs=0.5), "the middle stays where it is"
    assert moved(seen["dragged"]) == pytest.approx([4, 0, -37.5], abs=0.5), "no further than the edge"
    assert seen["errors"]["shown"] == [entries[0]["image"], entries[3]["error"], entries[4]["error"]]
    assert moved(seen["errors"]) == [1, 0, 0]
    assert seen["all"]["visible"] == [0, 1, 2, 3, 4] and seen["without path"]["visible"] == [0, 2, 4]
    assert seen["third"]["visible"] == [2] and seen["fourth"]["visible"] == [3]
