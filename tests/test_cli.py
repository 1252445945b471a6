"""The command `mi-neural`: what it writes, and the one line it gives for what cannot be done."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fake_cache import register
from test_benchmark import KEYS
from test_denoise import has_denoiser
from test_load import WHITE, boxes
from typer.main import get_command
from typer.testing import CliRunner

import mi_neural
from mi_neural import scenes
from mi_neural.bench import changes, elsewhere, load
from mi_neural.cli import app
from mi_neural.commands import options
from mi_neural.image import exr

SMALL = ("--size", "16x12")


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    register()


def run(*arguments: object, code: int = 0):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


def facts_of(file: str) -> dict:
    return json.loads(Path(file).read_text())


# ---------------------------------------------------------------- render


def test_render_writes_image_metadata_and_json():
    run("render", "cornell_box", *SMALL, "-i", "path", "--spp", 2, "-o", "a/b.exr", "--json", "b.json", "--seed", 7)
    facts = facts_of("b.json")
    assert set(KEYS) <= facts.keys()
    assert facts["scene"] == "cornell_box" and facts["spp"] == 2 and facts["size"] == [16, 12] and facts["seed"] == 7
    assert facts["relmse"] is None and facts["environment"]["mitsuba"]
    image = exr.read("a/b.exr")
    assert image.size == (16, 12) and image.metadata["integrator"] == "path" and image.metadata["spp"] == 2
    assert image.metadata["mean"] == pytest.approx(facts["mean"], rel=1e-5) == pytest.approx(image.rgb.mean(), rel=1e-5)
    assert facts["ns_per_sample"] == pytest.approx(1e9 * facts["seconds_render"] / (16 * 12 * 2))


def test_scene_whose_meshes_cannot_be_joined_is_rendered(tmp_path):
    """As exporters write them; Mitsuba itself: "Mesh::merge(): the two meshes are incompatible"."""
    plane, flipped = (f'<shape type="{kind}"> {WHITE} </shape>' for kind in ("rectangle", "cube"))
    flipped = flipped.replace(WHITE, f'<boolean name="flip_normals" value="true"/> {WHITE}')
    run("render", boxes(tmp_path / "b.xml", plane, flipped), *SMALL, "-i", "path", "--spp", 1, "-o", "a.exr")


def small_scene(integrator: str, n_balls: int = 1) -> str:
    sensor = '<sensor type="perspective"> <film type="hdrfilm"/> </sensor>'
    lamp = '<shape type="rectangle"> <emitter type="area"/> </shape>'
    balls = '<shape type="sphere"/>' * n_balls
    Path("a.xml").write_text(f'<scene version="3.0.0"> {integrator} {sensor} {lamp} {balls} </scene>')
    return "a.xml"


def test_depth_of_a_small_scene():
    """Joining its meshes moved the parsed parts in memory; the process ended where its integrator's keys were read."""
    for n in range(8):
        file = small_scene('<integrator type="path"> <integer name="max_depth" value="3"/> </integrator>', n)
        loaded = load.load_scene(file)
        assert loaded.carried == {"max_depth": 3} and loaded.integrator == "path"


def test_scene_that_names_no_integrator_is_rendered_by_path():
    run("render", small_scene(""), *SMALL, "--spp", 1, "--json", "a.json")
    assert facts_of("a.json")["integrator"] == "path"


def test_scene_without_surfaces(tmp_path):
    sensor = '<sensor type="perspective"> <film type="hdrfilm"/> </sensor>'
    Path("a.xml").write_text(f'<scene version="3.0.0"> {sensor} <emitter type="constant"/> </scene>')
    for name in ("nirc_two_level", "neural_path"):
        run("render", "a.xml", *SMALL, "-i", name, "--spp", 1, "--json", "a.json")
        assert facts_of("a.json")["mean"] == pytest.approx(1)


def test_scene_is_a_name_or_a_file_and_sizes_fit():
    run("render", scenes.path("cornell_box"), *SMALL, "-i", "path", "--spp", 1, "-o", "a.exr")
    run("render", "cornell_box", *SMALL, "-i", "path", "--spp", 1, "-o", "b.exr")
    assert np.allclose(exr.read("a.exr").rgb, exr.read("b.exr").rgb, rtol=1e-5)


def test_png_and_default_name():
    run("render", "cornell_box", *SMALL, "-i", "path", "--spp", 1, "-o", "a.png")
    run("render", "cornell_box", *SMALL, "-i", "path", "--spp", 1)
    assert Path("a.png").read_bytes()[:4] == b"\x89PNG" and exr.read("cornell_box_path.exr").size == (16, 12)


def test_errors_against_a_reference_are_those_of_the_written_image():
    run("render", "cornell_box", *SMALL, "-i", "path", "--spp", 64, "-o", "ref.exr", "--seed", 1)
    run("render", "cornell_box", *SMALL, "-i", "path", "--spp", 1, "--reference", "ref.exr", "--json", "raw.json")
    raw = facts_of("raw.json")
    assert raw["relmse"] > raw["relmse_trimmed"] > 0.0 and 0.0 < raw["flip"] < 1.0
    assert exr.read("cornell_box_path.exr").metadata["flip"] == pytest.approx(raw["flip"], rel=1e-5)
    if has_denoiser():
        run("render", "cornell_box", *SMALL, "-i", "path", "--spp", 1, "--reference", "ref.exr", "--denoise",
            "--json", "clean.json")  # fmt: skip
        clean = facts_of("clean.json")
        assert clean["denoised"] and clean["relmse"] != raw["relmse"] and clean["seconds_denoise"] > 0.0
        assert exr.read("cornell_box_path.exr").layer("noisy") is not None


def test_keys_reach_the_integrator():
    run("render", "cornell_box", *SMALL, "-i", "path", "--set", "max_depth=2", "--spp", 4, "--json", "a.json")
    run("render", "cornell_box", *SMALL, "-i", "path:max_depth=2", "--spp", 4, "--json", "b.json")
    run("render", "cornell_box", *SMALL, "-i", "path", "--spp", 4, "--json", "c.json")
    a, b, c = (facts_of(f"{n}.json") for n in "abc")
    assert a["parameters"]["max_depth"] == b["parameters"]["max_depth"] == 2
    assert a["mean"] == pytest.approx(b["mean"], rel=1e-4) and a["mean"] < 0.95 * c["mean"]


def test_cache_is_trained_saved_and_loaded():
    common = ("render", "cornell_box", *SMALL, "-i", "fake_cache", "--spp", 1)
    run(*common, "--pretrain", 5, "--save-cache", "c.bin", "--json", "a.json", "-o", "a.exr")
    assert Path("c.bin").read_text() == "fake 5"
    run(*common, "--load-cache", "c.bin", "-o", "b.exr")
    assert np.allclose(exr.read("a.exr").rgb, exr.read("b.exr").rgb, rtol=1e-5)
    assert (exr.read("b.exr").channels["frames"] == 5).all()
    assert facts_of("a.json")["records"] == 5
    Path("c.bin").write_text("nonsense")
    assert "c.bin is no cache file" in run(*common, "--load-cache", "c.bin", code=2).output


def test_seconds_are_kept():
    run("render", "cornell_box", *SMALL, "-i", "fake_cache:fraction=0.5", "--seconds", 1.5, "--json", "a.json")
    facts = facts_of("a.json")
    assert facts["budget_seconds"] == 1.5 and facts["spp"] > 1
    assert 1.0 < facts["seconds_train"] + facts["seconds_render"] < 3.0


def test_interrupt_writes_the_image_so_far():
    result = run("render", "cornell_box", *SMALL, "-i", "fake_cache:interrupt_render=3,fraction=0", "--seconds", 60,
                 "--json", "a.json", code=130)  # fmt: skip
    assert "interrupted" in result.output
    assert facts_of("a.json")["interrupted"] is True
    assert exr.read("cornell_box_fake_cache.exr").rgb.mean() > 0.0
    run(
        "render",
        "cornell_box",
        *SMALL,
        "-i",
        "fake_cache:interrupt_train=true",
        "--pretrain",
        9,
        "-o",
        "b.exr",
        code=130,
    )
    assert exr.read("b.exr").metadata["spp"] == 1


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to another process")
def test_ctrl_c_in_a_real_process():
    command = [sys.executable, "-m", "mi_neural.cli", "render", "cornell_box", *SMALL, "-i", "path", "--seconds", "60"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    for line in process.stderr:
        if "rendering" in line:
            break
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 130, stderr
    assert exr.read("cornell_box_path.exr").metadata["interrupted"] == "true" and "Traceback" not in stderr


# ---------------------------------------------------------------- compare, info


def test_compare_writes_report_table_and_images():
    arguments = [
        "compare",
        "cornell_box",
        *SMALL,
        "-i",
        "path",
        "-i",
        "fake_cache:fraction=0.1",
        "--seconds",
        "0.05,0.1",
    ]
    arguments += ["--steady", 2, "--frame-seconds", 0.05, "--reference-spp", 64, "--reference-cache", "references"]
    arguments += ["-o", "out"]
    result = run(*arguments, *(["--denoise"] if has_denoiser() else []))
    assert "fake_cache:fraction=0.1" in result.output and "report.html" in result.output
    results = facts_of("out/results.json")
    assert {row["mode"] for row in results["rows"]} == {"one-shot", "sample", "steady", "split", "curve"}
    rows = [row for row in results["rows"] if row["mode"] not in ("split", "curve")]
    for row in rows:
        assert set(KEYS) <= row.keys()
        image = exr.read(os.path.join("out", row["image"]))
        assert image.metadata["label"] == row["label"]
        assert os.path.exists(os.path.join("out", row["image"].replace(".exr", ".png")))
    assert len({row["image"] for row in rows}) == len(rows)
    assert all((row["flip_clean"] is not None) == has_denoiser() for row in rows)
    assert ("FLIP clean" in result.output) == has_denoiser()
    assert "</html>" in Path("out/report.html").read_text() and "fake_cache" in Path("out/table.md").read_text()


def test_interrupted_compare_reports_what_is_done():
    run("compare", "cornell_box", *SMALL, "-i", "path", "-i", "fake_cache:interrupt_render=2,fraction=0", "--seconds",
        "0.05", "--reference-spp", 32, "--reference-cache", "references", "-o", "out", code=130)  # fmt: skip
    rows = [row for row in facts_of("out/results.json")["rows"] if row["mode"] != "curve"]
    assert [row["label"].split(":")[0] for row in rows] == ["path", "fake_cache"]
    assert rows[1]["interrupted"] is True and "Interrupted" in Path("out/report.html").read_text()


def test_another_depth_than_the_references_is_said():
    run("render", "cornell_box", *SMALL, "-i", "path", "--spp", 1, "-o", "r.exr")
    exr.write("r.exr", exr.read("r.exr").rgb, metadata={"max_depth": "64"})
    result = run("render", "cornell_box", *SMALL, "-i", "path:max_depth=3", "--spp", 1, "--reference", "r.exr")
    assert "max_depth is 3, the reference was rendered with 64" in result.output


def test_help_and_version_are_where_they_are_expected():
    assert run("--version").output.strip() == mi_neural.__version__
    assert "Commands:" in run("-h").output and "--until-error" in run("render", "-h").output


def test_info_names_versions_and_llvm():
    text = run("info").output
    for word in ("mitsuba", "drjit", "llvm_ad_rgb", "cores", "cornell_box"):
        assert word in text


# ---------------------------------------------------------------- what cannot be done

RENDER = ("render", "cornell_box", *SMALL)
COMPARE = ("compare", "cornell_box", *SMALL, "-i", "path")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("render", "cornel_box"), r"did you mean 'cornell_box'"),
        (("render", "nothing_like_it"), "shipped scenes: .*cornell_box"),
        ((*RENDER, "-i", "pathh"), "unknown integrator 'pathh'.*of Mitsuba: path"),
        ((*RENDER, "-i", "diffuse"), "'diffuse' is no integrator"),
        ((*RENDER, "-i", "path", "--set", "zork=1"), "path has no key 'zork'"),
        ((*RENDER, "-i", "path:max_depth=deep"), "max_depth.*wrong type"),
        ((*RENDER, "-i", "path", "--set", "max_depth"), "--set takes key=value"),
        ((*RENDER, "-D", "zork=1"), "has no parameter zork"),
        ((*RENDER, "--spp", "4", "--seconds", "1"), "--spp and --seconds exclude each other"),
        ((*RENDER, "-i", "path", "-i", "nirc"), "-i/--integrator is given 2 times, .*compare SCENE -i A -i B"),
        ((*RENDER, "-o", "a.exr", "--output", "b.exr"), "--output/-o is given 2 times, and render takes it once"),
        ((*RENDER, "--spp", "4", "--spp", "4", "--spp=8"), "--spp is given 3 times, and render takes it once: leave"),
        (("plan", "cornell_box", "-i", "nirc", "-i", "nrc"), "-i/--integrator is given 2 times, and plan takes"),
        (("scenes", "get", "bistro", "--from", "a", "--from", "b"), "--from is given 2 times, and get takes it once"),
        (("reproduce", "--quick"), "--quick is for an entry: mi-neural reproduce NAME --quick"),
        (("reproduce", "--size", "8x8", "-o", "out"), "--size is for an entry: mi-neural reproduce NAME --size"),
        ((*RENDER, "--spp", "0"), "--spp must be greater than 0"),
        ((*RENDER, "--spp", "-3"), "--spp must be greater than 0"),
        ((*RENDER, "--seconds", "0"), "--seconds must be greater than 0"),
        ((*RENDER, "--seconds", "nan"), "--seconds must be greater than 0"),
        ((*RENDER, "--pretrain", "-1"), "--pretrain"),
        ((*RENDER, "-i", "nirc:light_sampler=tree_lights"), "-i nirc:light_sampler.type=tree_lights"),
        (("render", "cornell_box", "--size", "100000x100000", "-i", "path", "--spp", "1"), "the image: a film of"),
        (("render", "cornell_box", "--size", "100000x100000", "-i", "nrc", "--spp", "1"), "the image: a film of"),
        (("render", "cornell_box", "--size", "0x8"), "--size takes WIDTHxHEIGHT"),
        (("render", "cornell_box", "--size=-4x8"), "--size takes WIDTHxHEIGHT"),
        ((*RENDER, "--variant", "llvm_rgb"), "unknown variant 'llvm_rgb'; available: .*llvm_ad_rgb"),
        ((*RENDER, "-o", "a.jpg"), "ends in .exr or .png"),
        ((*RENDER, "-o", "file/a.exr"), "cannot write to the folder file"),
        ((*RENDER, "-o", "a.exr", "--json", "./a.exr"), "-o and --json name the same file"),
        ((*RENDER, "-o", "other.exr", "--reference", "other.exr"), "-o and --reference name the same file"),
        ((*RENDER, "--json", "file/a.json"), "cannot write to the folder file"),
        ((*RENDER, "--reference", "no.exr"), "no reference no.exr"),
        ((*RENDER, "--reference", "file"), "not a readable EXR"),
        ((*RENDER, "-i", "path", "-o", "a.exr", "--json", "./a.exr"), "-o and --json name the same file, a.exr"),
        ((*RENDER, "--reference", "fits.exr", "-o", "fits.exr"), "-o and --reference name the same file, fits.exr"),
        ((*RENDER, "-i", "fake_cache", "--load-cache", "file", "--json", "file"), "--json and --load-cache name"),
        ((*RENDER, "-i", "fake_cache", "--save-cache", "c", "-o", "a.png", "--json", "c"), "--json and --save-cache"),
        ((*RENDER, "--reference", "other.exr"), "other.exr is 5x4, the image 16x12"),
        ((*RENDER, "--reference", "nan.exr"), "non-finite pixels"),
        ((*RENDER, "-i", "path", "--save-cache", "c"), "path has no cache"),
        ((*RENDER, "-i", "path", "--pretrain", "3"), "path has no cache"),
        ((*RENDER, "-i", "plain_path", "--pretrain", "3"), "plain_path has no cache"),
        ((*RENDER, "-i", "plain_path:light_sampler.type=tree_lights", "--pretrain", "3"), "plain_path.* has no cache"),
        ((*RENDER, "-i", "fake_cache", "--load-cache", "no"), "no cache file no"),
        (COMPARE, "add -o DIR"),
        ((*COMPARE, "-o", "file/out"), "cannot write to the folder"),
        ((*COMPARE, "-o", "out", "--seconds", "1,x"), "--seconds takes seconds"),
        ((*COMPARE, "-o", "out", "--seconds", "1,-1"), "--seconds must be greater than 0"),
        ((*COMPARE, "-o", "out", "--seconds", "1", "--seconds", "2"), "--seconds is given 2 times.*values by commas"),
        ((*COMPARE, "-o", "out", "--frame-seconds", "1"), "needs --steady"),
        ((*COMPARE, "-o", "out", "--set", "zork=1"), "none of path has a key 'zork'"),
        ((*COMPARE, "-o", "out", "--reference", "a", "--reference-spp", "4"), "exclude each other"),
        ((*COMPARE, "-o", "out", "--repeats", "0"), "--repeats must be greater than 0"),
        ((*COMPARE, "lit_cube", "-o", "out", "--reference", "a"), "belongs to one scene, not to 2"),
        ((*COMPARE, "lit_cube", "-o", "out", "-D", "zork=1"), "none of the scenes has a parameter zork"),
        (("compare", "-o", "out"), "no scene: give names or files, or --scenes DIR"),
        (("compare", "--scenes", "nowhere", "-o", "out"), "no folder nowhere"),
        (("compare", "--scenes", ".", "-o", "out"), "no scene files in"),
        ((*COMPARE[:2], "--size", "16x12,3", "-o", "out"), "--size takes WIDTHxHEIGHT"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, message):
    Path("file").write_text("a file, no folder")
    exr.write("other.exr", np.ones((4, 5, 3)))
    exr.write("fits.exr", np.ones((12, 16, 3)))
    exr.write("nan.exr", np.full((12, 16, 3), np.nan))
    result = run(*arguments, code=2)
    lines = result.output.strip().splitlines()
    errors = [line for line in lines if line.startswith("mi-neural: ")]
    assert len(errors) == 1 and errors[0] == lines[-1] and "Traceback" not in result.output
    assert __import__("re").search(message, errors[0]), errors[0]
    assert not [f for f in os.listdir() if f.endswith((".png", "_path.exr"))]


def test_no_command_drops_an_option_that_is_given_twice():
    def commands(group):
        for command in group.commands.values():
            yield from commands(command) if hasattr(command, "commands") else [command]

    assert all(isinstance(command, options.Command) for command in commands(get_command(app)))
    run(*RENDER, "-i", "path:max_depth=2", "--set", "rr_depth=3", "--set", "max_depth=4", "--spp", 1, "-o", "a.exr")


def test_home_is_found_where_the_shell_did_not_write_it(monkeypatch):
    monkeypatch.setenv("HOME", "home")
    monkeypatch.setenv("USERPROFILE", "home")
    run(*RENDER, "-i", "path", "--spp", 1, "-o", "~/a/b.exr", "--json", "~/b.json")
    Path("home/cornell.xml").write_bytes(scenes.path("cornell_box").read_bytes())
    run("render", "~/cornell.xml", *SMALL, "-i", "path", "--spp", 1, "--reference", "~/a/b.exr", "-o", "~/a/c.exr")
    run("reproduce", "nothing", "-o", "~/out", code=2)
    assert sorted(os.listdir("home")) == ["a", "b.json", "cornell.xml"] and os.listdir() == ["home"]
    assert sorted(os.listdir("home/a")) == ["b.exr", "c.exr"]
    assert elsewhere.parse("other=~/a/b.exr,seconds=2").path == Path("home/a/b.exr")
    assert changes.bitmap("~/a/b.exr", 0, (12, 16, 3)).shape == (12, 16, 3)
    with pytest.raises(load.InputError, match=r"no scene file '~nobody-here/a.xml'"):
        load.find_scene("~nobody-here/a.xml")


def test_missing_denoiser_is_said_before_rendering(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    assert "pip install 'mi_neural[denoise]'" in run(*RENDER, "--denoise", code=2).output
