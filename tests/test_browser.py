"""A live view in a real JupyterLab in headless Chromium: frames, cells beside it, a click, a slider.

Skips where Chromium, JupyterLab or Playwright (``pip install playwright``; no browser of its own is downloaded) is
absent.
"""

import json
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = ("--headless=new --no-sandbox --disable-gpu --no-first-run --disable-background-networking "
         "--disable-component-update --disable-sync").split()  # fmt: skip

CELLS = (
    "import mi_neural\nimport mitsuba as mi\nmi.set_variant('llvm_ad_rgb')\nfrom mi_neural import scenes\n"
    "scene = mi.load_file(str(scenes.path('cornell_box')))\nview = mi_neural.live(scene, 'nirc')\nview",
    "6 * 7",
    "import json\nprint(json.dumps({'fps': view.canvas.get_stats()['fps'], 'taken': view.session.taken,\n"
    "    'azimuth': view.session.camera.azimuth, 'clicked': view.hemisphere is not None, 'running': view.running}))",
)


@pytest.fixture
def lab(tmp_path):
    """The address of a JupyterLab that holds `live.ipynb`."""
    pytest.importorskip("jupyterlab", reason="needs the extra `notebooks`")
    cells = [{"cell_type": "code", "execution_count": None, "id": f"c{k}", "metadata": {}, "outputs": [], "source": s}
             for k, s in enumerate(CELLS)]  # fmt: skip
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    notebook = {"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}
    (tmp_path / "live.ipynb").write_text(json.dumps(notebook))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", f"--port={port}", "--ip=127.0.0.1",
               "--IdentityProvider.token=", f"--ServerApp.root_dir={tmp_path}", "--LabApp.news_url=None",
               "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate"]  # fmt: skip
    with (tmp_path / "lab.log").open("w") as log:
        server = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
    try:
        address = f"http://127.0.0.1:{port}"
        for _ in range(120):
            try:
                urllib.request.urlopen(f"{address}/api").close()
                break
            except (urllib.error.URLError, ConnectionError):
                time.sleep(0.5)
        else:
            pytest.skip("JupyterLab did not start: " + (tmp_path / "lab.log").read_text()[-500:])
        yield address
    finally:
        server.terminate()
        server.wait(30)


@pytest.mark.slow
def test_live_view_in_jupyterlab(lab, tmp_path):
    playwright = pytest.importorskip("playwright.sync_api", reason="needs: pip install playwright")
    if CHROMIUM is None:
        pytest.skip("needs Chromium in PATH")
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=FLAGS, headless=True)
        page = browser.new_page(viewport={"width": 1400, "height": 1300})
        page.goto(f"{lab}/lab/tree/live.ipynb?reset")
        page.wait_for_selector(".jp-CodeCell .cm-content", timeout=60_000)
        page.wait_for_selector(".jp-Notebook-ExecutionIndicator[data-status=idle]", timeout=60_000)
        cells = page.locator(".jp-CodeCell")

        def run(k: int) -> None:
            cells.nth(k).locator(".cm-content").click()
            page.keyboard.press("Shift+Enter")

        def facts() -> dict:
            before = cells.nth(2).locator(".jp-InputPrompt").inner_text()
            run(2)
            page.wait_for_function(
                "([cell, before]) => { const t = cell.querySelector('.jp-InputPrompt').innerText;"
                " return t !== before && /\\d/.test(t); }",
                arg=[cells.nth(2).element_handle(), before], timeout=60_000,
            )  # fmt: skip
            page.wait_for_timeout(300)
            return json.loads(cells.nth(2).locator(".jp-OutputArea-output pre").last.inner_text())

        run(0)
        picture = page.locator(".renderview-wrapper")
        picture.wait_for(timeout=180_000)
        page.wait_for_timeout(8000)
        run(1)
        page.wait_for_function(
            "cell => cell.querySelector('.jp-OutputArea-output')?.innerText.trim() === '42'",
            arg=cells.nth(1).element_handle(), timeout=10_000,
        )  # fmt: skip
        first = facts()
        assert first["running"] and first["taken"] > 5 and first["fps"] > 2, first

        picture.scroll_into_view_if_needed()
        picture.click(position={"x": 120, "y": 300})
        page.locator("text=path-traced").wait_for(timeout=20_000)
        handle = page.locator(".widget-tab .noUi-handle, .jupyter-widget-tab .noUi-handle").first
        handle.focus()
        for _ in range(5):
            page.keyboard.press("ArrowRight")
        page.wait_for_timeout(1500)
        page.screenshot(path=str(tmp_path / "live.png"))
        last = facts()
        assert last["clicked"] and last["azimuth"] == 5 and last["running"], last
        browser.close()
