"""Programs that are stopped, killed, or have no place to write: what was done is there, and the next run goes on.

Real processes and signals.
"""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from mi_neural.image import exr

SMALL = ("cornell_box", "--size", "16x16")
COMPARE = ("compare", *SMALL, "-i", "path", "-i", "plain_path", "--seconds", "0.1,0.2", "--reference-spp", "32",
           "--reference-cache", "references", "-o", "out")  # fmt: skip


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def start(*arguments, **options) -> subprocess.Popen:
    command = [sys.executable, "-m", "mi_neural.cli", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def wait_for(process, text: str) -> None:
    """Until the program's standard error says `text`."""
    for line in process.stderr:
        if text in line:
            return
    raise AssertionError(f"it ended before it said {text!r}")


def finish(process) -> tuple[int, str]:
    _, stderr = process.communicate(timeout=120)
    assert "Traceback" not in stderr
    return process.returncode, stderr


def done(*arguments) -> str:
    """Run a command to its end; what it says."""
    process = start(*arguments)
    stdout, stderr = process.communicate(timeout=240)
    assert process.returncode == 0, stderr
    return stdout + stderr


# ---------------------------------------------------------------- render


def test_sigterm_stops_a_rendering_as_ctrl_c_does():
    process = start("render", *SMALL, "-i", "path", "--seconds", 60)
    wait_for(process, "rendering")
    time.sleep(0.3)
    process.send_signal(signal.SIGTERM)
    code, stderr = finish(process)
    assert code == 143 and "interrupted" in stderr
    image = exr.read("cornell_box_path.exr")
    assert image.metadata["interrupted"] == "true" and np.isfinite(image.rgb).all() and image.rgb.mean() > 0


def test_image_whose_folder_is_gone_is_saved_elsewhere():
    process = start("render", *SMALL, "-i", "path", "--seconds", 60, "-o", "sub/a.exr")
    wait_for(process, "rendering")
    time.sleep(0.3)
    shutil.rmtree("sub")
    process.send_signal(signal.SIGINT)
    code, stderr = finish(process)
    assert code == 2 and "cannot write sub/a.exr" in stderr
    refuge = Path(stderr.split("the image is in ")[1].split(" (MI_NEURAL")[0].strip())
    assert refuge.parent.parent == Path(tempfile.gettempdir()) and exr.read(refuge).rgb.mean() > 0
    shutil.rmtree(refuge.parent)


def test_killed_rendering_leaves_the_image_that_was_kept_last():
    """As it is kept every minute; here five times a second."""
    arguments = ["mi-neural", "render", *SMALL, "-i", "path", "--seconds", "60", "-o", "a.exr"]
    code = (
        f"import sys; sys.argv = {arguments}\nfrom mi_neural.bench import budget; budget.KEEP_SECONDS = 0.2\n"
        "from mi_neural.cli import main; main()"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not Path("a.exr").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    process.communicate()
    image = exr.read("a.exr")
    assert image.metadata["interrupted"] == "true" and image.metadata["spp"] >= 1 and image.rgb.mean() > 0


# ---------------------------------------------------------------- compare


def test_killed_compare_goes_on_with_the_rows_that_it_has():
    process = start(*COMPARE)
    wait_for(process, "plain_path: compiling")
    process.kill()
    process.communicate()
    lines = Path("out/rows.jsonl").read_text().splitlines()
    before = [row for line in lines[1:] if (row := json.loads(line))["mode"] != "curve"]
    assert [(r["label"], r["budget_seconds"]) for r in before] == [("path", 0.1), ("path", 0.2)]
    assert all(exr.read(f"out/{r['image']}").metadata["label"] == "path" for r in before)
    with open("out/rows.jsonl", "a") as file:
        file.write('{"scene": "half a li')  # as if killed while it wrote

    said = done(*COMPARE)
    steps = said.splitlines()
    assert f"{len(lines) - 1} rows are there already" in said
    assert "plain_path: compiling" in steps and "path: compiling" not in steps
    all_rows = json.loads(Path("out/results.json").read_text())["rows"]
    rows = [row for row in all_rows if row["mode"] != "curve"]
    assert [r["label"] for r in rows] == ["path"] * 2 + ["plain_path"] * 2
    for kept, row in zip(before, rows, strict=False):
        assert all(kept[k] == row[k] for k in ("spp", "seconds_total", "mean", "relmse", "flip"))
    assert not Path("out/rows.jsonl").exists() and "</html>" in Path("out/report.html").read_text()


# ---------------------------------------------------------------- sequence


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_stopped_sequence_goes_on_with_the_frames_that_it_has(number):
    """With a cache, frames since its latest file are rendered anew: `test_sequence`."""
    frames = 300
    command = ("sequence", *SMALL, "-i", "path", "--frames", frames, "--no-reference", "-o", "out")
    process = start(*command)
    wait_for(process, "frames")
    kept = Path("out/path/frames.jsonl")
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline and not (kept.exists() and len(kept.read_text().splitlines()) >= 5):
        time.sleep(0.01)
    process.send_signal(number)
    process.communicate(timeout=120)
    assert process.returncode in (-number, 128 + number)
    rows = kept.read_text().splitlines()
    n = len(rows) - 1  # the last may be half a line
    images = [Path(f"out/path/frame_{k:04d}.exr") for k in range(n)]
    before = [p.read_bytes() for p in images]
    assert 4 <= n < frames and exr.read(images[-1]).rgb.mean() > 0
    done(*command)
    after = kept.read_text().splitlines()
    assert len(after) == frames and after[:n] == rows[:n]
    assert [p.read_bytes() for p in images] == before


# ---------------------------------------------------------------- full disk


def limited() -> None:
    """No file of this process may be longer than 4 kB: what a full disk looks like to a program."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))


WRITERS = {
    "exr": "from mi_neural.image import exr; exr.write('old', rng.random((64, 64, 3)))",
    "png": "from mi_neural.image import exr; exr.write_png('old', rng.random((64, 64, 3)))",
    "text": "from mi_neural.image import exr; exr.write_text('old', 'x' * 10000)",
    "cache": "from mi_neural.caches import files; files.write('old', 'incident', {}, {'a': rng.random(10000)})",
}


@pytest.mark.parametrize("kind", WRITERS)
def test_file_that_does_not_fit_the_disk_is_an_error_and_the_old_one_stays(kind):
    Path("old").write_text("what was there")
    code = f"import numpy as np; rng = np.random.default_rng(0)\n{WRITERS[kind]}"
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, preexec_fn=limited, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 1 and "OSError" in ended.stderr.splitlines()[-1], (ended.returncode, ended.stderr)
    assert Path("old").read_text() == "what was there" and os.listdir() == ["old"]


@pytest.fixture
def tiny_disk(tmp_path):
    """A disk of 64 kB; skips where this user cannot mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)], capture_output=True)
    if mounted.returncode:
        pytest.skip("only an administrator can mount the small disk that this test fills")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.slow
def test_rendering_onto_a_full_disk_saves_the_image_elsewhere(tiny_disk):
    out = tiny_disk / "a.exr"
    process = start("render", "cornell_box", "--size", "128x128", "-i", "path", "--spp", 4, "-o", out)
    code, stderr = finish(process)
    assert code == 2 and f"cannot write {out}" in stderr and os.listdir(tiny_disk) == []
    refuge = Path(stderr.split("the image is in ")[1].split(" (MI_NEURAL")[0].strip())
    assert exr.read(refuge).size == (128, 128)
    shutil.rmtree(refuge.parent)


@pytest.mark.slow
def test_compare_onto_a_full_disk_keeps_the_rows_that_fit_and_goes_on(tiny_disk):
    command = [*COMPARE[:-1], tiny_disk]
    (tiny_disk / "ballast").write_bytes(bytes(40_000))
    process = start(*command)
    code, stderr = finish(process)
    assert code == 2, stderr
    for image in tiny_disk.glob("*.exr"):
        assert np.isfinite(exr.read(image).rgb).all()
    assert not list(tiny_disk.glob(".*"))
