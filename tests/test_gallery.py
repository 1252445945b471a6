"""The gallery: built from results as `compare` and `sequence` write them, with commands that parse."""

import json
import re
import shlex

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from mi_neural import cli
from mi_neural.bench import gallery
from mi_neural.bench.load import InputError
from mi_neural.image import exr, metrics


@pytest.fixture
def results(tmp_path):
    """A comparison of two integrators and a sequence of three frames, as their commands leave them."""
    done = tmp_path / "1_box"
    done.mkdir()
    rng = np.random.default_rng(0)
    reference = rng.uniform(0.2, 1, (8, 12, 3))
    exr.write(done / "reference.exr", reference)
    rows = []
    for label, error in (("path", 0.0), ("nirc:cache_samples=8", 0.5)):
        image = label.replace(":", "_") + ".exr"
        exr.write(done / image, reference + error)
        rows.append({
            "scene": "box", "label": label, "image": image, "mode": "steady", "denoised": False, "size": [12, 8],
            "spp": 3.0,
            "budget_seconds": 0.25, "pretrain_frames": 200, "seconds_pretrain": 4.0, "seconds_train": 0.03,
            "seconds_render": 0.2, "relmse_trimmed": error, "flip": error,
        })  # fmt: skip
    command = "mi-neural compare box.xml -i path -D depth=3 -i nirc:cache_samples=8 --steady 200 -o out/1_box"
    scene = {"scene": "box", "size": [12, 8], "reference": {"path": str(done / "reference.exr")}}
    others = [{**rows[0], "mode": "sample"}, {**rows[0], "denoised": True}, {**rows[0], "image": None}]
    found = {"command": command, "scenes": [scene], "rows": [*others, *rows]}
    (done / "results.json").write_text(json.dumps(found))

    moving = tmp_path / "2_moving"
    for case in ("path", "nirc"):
        (moving / case).mkdir(parents=True)
        for k in range(3):
            exr.write(moving / case / f"frame_{k:04d}.exr", np.full((8, 8, 3), 0.1 * (k + 1)))
    cases = [{"label": name, "folder": name, "rows": [{}] * 3} for name in ("path", "nirc")]
    found = {"scene": "box", "command": "mi-neural sequence box.xml -o x", "cases": cases}
    (moving / "results.json").write_text(json.dumps(found))
    return tmp_path


def test_page_shows_every_integrator_once_with_error_map_and_command(results):
    gallery.write(results)
    text = (results / "index.html").read_text(encoding="utf-8")
    assert text.count("<b>path</b>") == 1 and text.count("<b>nirc:cache_samples=8</b>") == 1
    for target in re.findall(r'(?:src)="([^"]+)"', text):
        assert (results / target).is_file(), target
    assert "0.23 s, 0.03 of it training, 3 samples a pixel, 4 s of training before" in text
    black, bright = (exr_png_mean(results / f"1_box/{n}_flip.png") for n in ("path", "nirc_cache_samples=8"))
    assert black < 3 < bright, "no error is black, an error is not"


def exr_png_mean(path) -> float:
    from PIL import Image

    with Image.open(path) as image:
        return float(np.asarray(image).mean())


def test_commands_of_pictures_have_options_that_exist(results):
    gallery.write(results)
    text = (results / "index.html").read_text(encoding="utf-8")
    commands = re.findall(r"<code>(mi-neural render [^<]+)</code>", text)
    assert commands[0] == (
        "mi-neural render box.xml -i path -D depth=3 --size 12x8 --pretrain 200 --seconds 0.25 -o picture.png"
    )
    help_ = CliRunner().invoke(cli.app, ["render", "--help"]).output
    for command in commands:
        for option in (w for w in shlex.split(command) if w.startswith("-")):
            assert re.search(rf"(^|[\s,]){option}\b", help_), option


def test_commands_of_pictures_have_what_was_typed_in_any_form(results):
    typed = "mi-neural compare box.xml --set train_steps=2 --set outputs=4 -D a=1 -Db=2 --define=c=3 --define d=4 -o x"
    row = json.loads((results / "1_box" / "results.json").read_text())["rows"][-1]
    made = gallery.command_of({**row, "parameters": {"train_steps": 2}}, typed)
    assert " --set train_steps=2 -D a=1 -D b=2 -D c=3 -D d=4 --size " in made


def test_images_are_compared_with_a_reference_of_another_size_as_compare_does(results):
    small = exr.read(results / "1_box" / "reference.exr").rgb
    for shape in ((16, 24), (4, 6)):
        reference = np.repeat(np.repeat(small, 2, 0), 2, 1) if shape[0] > 8 else metrics.block_means(small, shape)
        exr.write(results / "1_box" / "reference.exr", reference)
        gallery.write(results)
        assert exr_png_mean(results / "1_box/path_flip.png") < 3


def test_program_says_in_one_line_what_is_wrong(tmp_path):
    made = typer.Typer()
    made.command()(gallery.main)
    found = CliRunner().invoke(made, [str(tmp_path)])
    assert found.exit_code == 2 and found.output.startswith(f"{tmp_path} holds no results") and "\n" == found.output[-1]


def test_sheet_and_animation(results):
    from PIL import Image

    gallery.write(results, results / "sheet.webp", results / "moving.webp")
    with Image.open(results / "sheet.webp") as sheet:
        assert sheet.size == (3 * 12 + 2 * 4, 8), "reference and two pictures"
    with Image.open(results / "moving.webp") as moving:
        assert moving.n_frames == 3 and moving.size == (8 + 4 + 8, 8)


def test_a_reference_that_is_gone_is_reported(results):
    (results / "1_box" / "reference.exr").unlink()
    with pytest.raises(InputError, match="is gone: run its mi-neural compare again"):
        gallery.write(results)


def test_nothing_to_show_says_what_to_do(tmp_path):
    with pytest.raises(InputError, match="holds no results"):
        gallery.write(tmp_path)
