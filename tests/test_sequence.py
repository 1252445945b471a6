"""Sequences: parameters by frame, what is refused, frames and references on disk, going on after an interruption."""

import importlib
import json
from itertools import pairwise
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from fake_cache import register
from typer.testing import CliRunner

from mi_neural.bench import benchmark, changes, load, plots, sequence, sequence_pictures
from mi_neural.bench.load import InputError
from mi_neural.bench.specs import parse_integrator
from mi_neural.cli import app
from mi_neural.image import exr

T = mi.ScalarTransform4f
N = 24  # pixels of a side


def texture(level: float = 0.5) -> np.ndarray:
    return np.full((4, 4, 3), level, np.float32)


def make(ball=(0.0, 0.0, 0.0), cube=(1.0, 0.0, 1.0), lamp=(0.0, 2.0, 0.0), sun=(0.0, -1.0, -1.0), power=1.0, eye=6.0,
         level=0.5):  # fmt: skip
    """A floor with a sphere, a cube and an emissive cube under sun and sky; every part where the arguments say."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4},
            "camera": {
                "type": "perspective",
                "fov": 45,
                "to_world": T().look_at([0, 2, eye], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": N, "height": N, "rfilter": {"type": "box"}},
            },
            "floor": {
                "type": "rectangle",
                "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(4),
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(texture(level)), "raw": True},
                },
            },
            "sun": {"type": "directional", "direction": list(sun), "irradiance": power},
            "sky": {"type": "constant", "radiance": 0.1},
            "ball": {"type": "sphere", "radius": 0.5, "to_world": T().translate(list(ball))},
            "cube": {"type": "cube", "to_world": T().translate(list(cube)).scale(0.4)},
            "lamp": {
                "type": "cube",
                "to_world": T().translate(list(lamp)).scale(0.3),
                "emitter": {"type": "area", "radiance": 4.0},
            },
        }
    )


def image(scene, spp: int = 8) -> np.ndarray:
    return np.array(mi.render(scene, spp=spp, seed=3))


def at(scene, frame: int = 1, frames: int = 2, change_at=None, **texts: str) -> sequence.Sequence:
    """A sequence made from expressions (`__` for dots in keys), applied to one frame."""
    functions = changes.parse([f"{k.replace('__', '.')}={v}" for k, v in texts.items()], frames, change_at)
    found = sequence.Sequence(scene, functions, frames, change_at)
    found.apply(frame)
    return found


# ---------------------------------------------------------------- every kind of parameter

KINDS = {
    "light direction": ({"sun__direction": "array([1, -1, 0])"}, {"sun": (1, -1, 0)}),
    "light transform": ({"sun__to_world": "rotate([0, 1, 0], 90) @ value"}, {"sun": (-1, -1, 0)}),
    "light intensity": ({"irradiance": "value * (1 + 2 * t)"}, {"power": 3.0}),
    "camera": ({"camera__to_world": "look_at([0, 2, 7], [0, 0, 0])"}, {"eye": 7.0}),
    "sphere": ({"ball__to_world": "translate(-1.2, 0, 0) @ value"}, {"ball": (-1.2, 0, 0)}),
    "mesh": ({"cube__to_world": "translate(-2, 0.5, 0) @ value"}, {"cube": (-1, 0.5, 1)}),
    "emissive mesh": ({"lamp__to_world": "translate([1.5, -1, 0]) @ value"}, {"lamp": (1.5, 1, 0)}),
    "texture": ({"floor__bsdf__reflectance__data": "0.4 * value"}, {"level": 0.2}),
    "two at once": (
        {"ball__to_world": "translate(-1, 0, 0) @ value", "sun__irradiance": "0 * value"},
        {"ball": (-1, 0, 0), "power": 0.0},
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_changed_scene_is_the_scene_made_so(kind):
    """Rays, light and emitter sampling see the new state: the image is that of a scene loaded with it, and restored,
    that of the scene before."""
    texts, arguments = KINDS[kind]
    scene = make()
    before = image(scene)
    found = at(scene, **texts)
    changed, expected = image(scene), image(make(**arguments))
    assert np.abs(expected - before).max() > 1e-2
    assert changed == pytest.approx(expected, rel=2e-3, abs=2e-4)
    assert found.restore() and image(scene) == pytest.approx(before, rel=1e-5, abs=1e-6)
    assert not found.restore()


def test_frames_need_no_kernels_of_their_own():
    """Values are data, not constants: what was compiled in the state of frame 0 serves all others."""
    import drjit as dr

    scene = make()
    texts = ["sun.direction=rotated(value, [0, 1, 0], 10 * frame)", "sun.irradiance=value * (1 + frame)",
             "lamp.to_world=translate(0.1 * frame, 0, 0) @ value", "ball.to_world=translate(0.1 * frame, 0, 0) @ value",
             "camera.to_world=translate(0, 0, 0.1 * frame) @ value", "floor.to_world=translate(0, t, 0) @ value",
             "sky.radiance=value * (1 + t)"]  # fmt: skip
    found = sequence.Sequence(scene, changes.parse(texts, 4), 4)
    kernels = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for frame in range(4):
            found.apply(frame)
            dr.kernel_history_clear()
            image(scene)
            kernels.append({k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT})
        dr.kernel_history_clear()
    assert kernels[1] and all(k <= kernels[0] for k in kernels)


def test_a_turned_mesh_keeps_smooth_normals_of_unit_length():
    mesh = mi.Mesh("round", 4, 4, has_vertex_normals=True)
    params = mi.traverse(mesh)
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float64)
    params["vertex_positions"] = corners.ravel()
    params["vertex_normals"] = (corners / np.sqrt(3)).ravel()
    params["faces"] = np.array([0, 1, 2, 0, 3, 1, 0, 2, 3, 1, 3, 2], np.uint32)
    params.update()
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    at(scene, mesh__to_world="rotate([0, 0, 1], 90) @ scale(2, 1, 1) @ value")
    params = mi.traverse(scene)
    positions = np.array(params["mesh.vertex_positions"]).reshape(-1, 3)
    normals = np.array(params["mesh.vertex_normals"]).reshape(-1, 3)
    assert positions == pytest.approx(np.stack([-corners[:, 1], 2 * corners[:, 0], corners[:, 2]], axis=1), abs=1e-6)
    expected = np.stack([-corners[:, 1], corners[:, 0] / 2, corners[:, 2]], axis=1) / 1.5
    assert normals == pytest.approx(expected, abs=1e-6)


def test_bitmaps_by_frame(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = make()
    for frame, level in enumerate((0.5, 0.1)):
        exr.write(f"floor_{frame:04d}.exr", texture(level))
    found = at(scene, floor__bsdf__reflectance="bitmap('floor_%04d.exr')")
    assert found.states[0] == "" != found.states[1]
    assert np.array(mi.traverse(scene)["floor.bsdf.reflectance.data"]) == pytest.approx(0.1)
    with pytest.raises(InputError, match=r"reflectance.data at frame 2: bitmap: there is no file floor_0002.exr"):
        at(scene, frames=3, floor__bsdf__reflectance="bitmap('floor_%04d.exr')")


def test_functions_from_python_and_states():
    scene = make()
    asked = []

    def power(frame, value):
        asked.append(frame)
        return value * (1 + (frame >= 3))

    found = sequence.Sequence(scene, {"sun.irradiance": power}, frames=6)
    assert set(asked) == set(range(6))  # all of them before the first frame
    assert found.states[:3] == [""] * 3 and len(set(found.states)) == 2 and found.change == 3
    assert not found.apply(1) and found.apply(4) and not found.apply(5)
    assert np.array(mi.traverse(scene)["sun.irradiance.value"]) == pytest.approx(2.0)


def test_expressions_know_frame_time_and_change():
    value = np.array([1.0, 2.0, 3.0])

    def result(text: str, frame: int) -> np.ndarray:
        return np.asarray(changes.expression("key", text, 11, 4)(frame, value))

    assert [float(result("100 * after + 10 * s + t", k)) for k in (0, 3, 4, 10)] == pytest.approx([0, 0.3, 100.4, 161])
    assert result("where(value > 1.5, 0, value[::-1]) if n == 11 else 7", 0) == pytest.approx([3, 0, 0])
    assert result("rotated(value, [0, 0, 1], 90)", 0) == pytest.approx([-2, 1, 3])
    assert (result("rotate([0, 1, 0], 180, [1, 0, 0])", 0) @ [0, 0, 0, 1]) == pytest.approx([2, 0, 0, 1])
    assert result("look_at([1, 2, 3], [0, 0.5, 0])", 0) == pytest.approx(
        np.array(T().look_at([1, 2, 3], [0, 0.5, 0], [0, 1, 0]).matrix), abs=1e-6
    )
    assert result("([1, 2, 3] * 99999999999)[frame] / 99999999999", 2) == 3, "no list of so many numbers"
    assert result("2 ** frame", 10) == pytest.approx(1024)


# ---------------------------------------------------------------- what is refused, before the first frame

BAD = {
    "unknown": ({"nonsense.power": "1"}, r"no such parameter; .*mi.traverse"),
    "misspelt": ({"sun.irradianc": "value"}, r"no such parameter; close to it: sun.irradiance.value"),
    "ambiguous": ({"to_world": "value"}, r"parameters end in that; type one of: .*camera.to_world"),
    "film": ({"camera.film.size": "value"}, "the film stays as it is"),
    "shape": ({"ball.to_world": "array([1, 2, 3])"}, r"ball.to_world at frame 0: gives shape \(3,\).* \(4, 4\)"),
    "nan": ({"irradiance": "value / (frame - 2)"}, r"irradiance.value at frame 2: gives NaN or infinite"),
    "flat": ({"ball.to_world": "scale(1, 1, 1 - frame) @ value"}, "at frame 1: gives a matrix that flattens"),
    "last row": ({"ball.to_world": "2 * value"}, r"last row is \[0.0, 0.0, 0.0, 2.0\]"),
    "no direction": ({"direction": "0 * value"}, r"gives the direction \[0, 0, 0\]"),
    "fails": ({"irradiance": "value[3]"}, "at frame 0: IndexError"),
    "twice": ({"direction": "value", "sun.to_world": "value"}, "sun.direction and sun.to_world: .*changed twice"),
    "syntax": ({"irradiance": "value *"}, "not an expression"),
    "name": ({"irradiance": "os"}, "unknown name 'os'; it may use abs, after"),
    "attribute": ({"irradiance": "value.real"}, "'value.real' is not allowed"),
    "import": ({"irradiance": "__import__('os')"}, "unknown name '__import__'"),
    "text": ({"irradiance": "'a' * 9"}, "is not allowed"),
    "shift": ({"irradiance": "value * (1 << 99)"}, "is not allowed"),
    "long name": ({"irradiance": "bitmap('%999999999d.exr')"}, "needs one place for the frame"),
    "lambda": ({"irradiance": "(lambda: 1)()"}, "is not allowed"),
    "when": ({"irradiance": "value * after"}, "uses 'after': say when, with --change-at FRAME"),
    "no bitmap": ({"irradiance": "bitmap('x.exr')"}, "no file x.exr"),
}


@pytest.fixture(scope="module")
def still():
    """A scene that no test changes."""
    return make()


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_is_one_line(kind, still):
    texts, message = BAD[kind]
    with pytest.raises(InputError, match=message) as error:
        sequence.Sequence(still, changes.parse([f"{k}={v}" for k, v in texts.items()], 4), 4)
    assert "\n" not in str(error.value)


def test_frames_and_change_are_checked(still):
    for arguments, message in (
        ((0,), "--frames takes a number of frames from 1, got 0"),
        ((10, 10), "--change-at 10 is after the end: the frames are 0 to 9, give 1 to 9"),
        ((10, 0), "--change-at 0 is not after the first frame"),
    ):
        with pytest.raises(InputError, match=message):
            sequence.Sequence(still, {}, *arguments)
    with pytest.raises(InputError, match="frame 1: gives a str"):
        sequence.Sequence(still, {"irradiance": lambda frame, value: value if frame == 0 else "x"}, 3)
    with pytest.raises(InputError, match="there is no frame 3"):
        sequence.Sequence(still, {}, 3).apply(3)


# ---------------------------------------------------------------- runs


@pytest.fixture
def loaded() -> load.LoadedScene:
    register()
    return load.load_scene("cornell_box", (16, 16), merge=False)


LAMP = "lamp_panel.emitter.radiance"


def run_of(loaded, folder: Path, text: str = "value*(1+after)", specs=("path",), frames=4, spp=2, reference=8, **plan):
    functions = changes.parse([f"{LAMP}={text}"], frames, 2)
    over_time = sequence.Sequence(loaded.scene, functions, frames, 2)
    folder.mkdir(exist_ok=True)
    run = sequence.Run(loaded, over_time, sequence.Plan(spp=spp, **plan), folder, reference)
    return run, benchmark.make_cases(loaded, [parse_integrator(s) for s in specs])


def rows_of(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]


def test_an_abrupt_change_needs_two_references(loaded, tmp_path):
    run, cases = run_of(loaded, tmp_path)
    results = run.run(cases)
    assert len(list((tmp_path / "references").iterdir())) == 2
    rows = rows_of(tmp_path / "path")
    assert [r["frame"] for r in rows] == [0, 1, 2, 3] and rows == results[0].rows
    assert all(0 < r["flip"] < 1 and r["relmse_trimmed"] <= r["relmse"] and r["seconds"] > 0 for r in rows)
    assert rows[0]["smape"] is None and all(r["smape"] > 0 for r in rows[1:])
    assert [r["smape_reference"] == 0 for r in rows[1:]] == [True, False, True]
    assert rows[3]["mean"] == pytest.approx(2 * rows[0]["mean"], rel=0.2)
    frame = exr.read(tmp_path / "path" / "frame_0002.exr")
    assert frame.metadata["frame"] == 2 and frame.metadata["integrator"] == "path"
    assert frame.metadata["flip"] == pytest.approx(rows[2]["flip"], rel=1e-5)
    assert not run.sequence.restore()  # the scene is as it was

    kept = {f: f.stat().st_mtime_ns for f in tmp_path.rglob("*.exr")}
    again, cases = run_of(loaded, tmp_path)  # a finished one does nothing
    assert again.run(cases)[0].rows == rows
    assert {f: f.stat().st_mtime_ns for f in tmp_path.rglob("*.exr")} == kept


def test_a_smooth_change_has_a_reference_for_each_frame(loaded, tmp_path):
    run, cases = run_of(loaded, tmp_path, text="value*(1+t)", frames=5, spp=64)
    rows = run.run(cases)[0].rows
    assert len(list((tmp_path / "references").iterdir())) == 5
    assert all(a["mean"] < b["mean"] for a, b in pairwise(rows))


def test_going_on_equals_not_stopping(loaded, tmp_path):
    whole, cases = run_of(loaded, tmp_path / "whole", reference=None)
    whole.run(cases)
    part, cases = run_of(loaded, tmp_path / "part", reference=None)
    render, calls = cases[0].integrator.render, []

    class Interrupted:
        def render(self, **arguments):
            calls.append(1)
            if len(calls) == 4:  # compiling, frame 0, frame 1
                raise KeyboardInterrupt
            return render(**arguments)

    cases[0].integrator = Interrupted()
    with pytest.raises(KeyboardInterrupt):
        part.run(cases)
    assert len(part.results[0].rows) == 2 and part.sequence._current == [""]
    with open(tmp_path / "part" / "path" / "frames.jsonl", "a") as file:
        file.write('{"frame": 2, "sta')  # a line cut short

    part, cases = run_of(loaded, tmp_path / "part", reference=None)
    part.run(cases)
    for frame in range(4):
        first, second = (exr.read(tmp_path / d / "path" / f"frame_{frame:04d}.exr").rgb for d in ("whole", "part"))
        assert second == pytest.approx(first, rel=1e-5)
    first, second = ([r["smape"] for r in rows_of(tmp_path / d / "path")][1:] for d in ("whole", "part"))
    assert second == pytest.approx(first, rel=1e-4)


def test_a_cache_is_brought_back(loaded, tmp_path):
    """Frames of the fake cache are `path` times 1 + 1 / (1 + frames trained): 5 after pretraining, and it stays."""
    run, cases = run_of(loaded, tmp_path, specs=["fake_cache"], reference=None, pretrain=5)
    cases[0].integrator.interrupt_render = 5  # in frame 2: it counts two calls a pass
    with pytest.raises(KeyboardInterrupt):
        run.run(cases)
    folder = tmp_path / "fake_cache"
    assert len(rows_of(folder)) == 2 and len(list(folder.glob("cache_*.npz"))) == 1
    run, cases = run_of(loaded, tmp_path, specs=["fake_cache"], reference=None, pretrain=5)
    run.run(cases)
    assert cases[0].integrator.frames == 5 and [r["frame"] for r in rows_of(folder)] == [0, 1, 2, 3]
    assert json.loads((folder / "sequence.json").read_text())["facts"]["pretrained"] == 5
    assert exr.read(folder / "frame_0003.exr").channels["frames"].max() == 5


def test_other_settings_need_another_folder(loaded, tmp_path, monkeypatch):
    run, cases = run_of(loaded, tmp_path, reference=None)
    run.run(cases)
    for arguments, message in (
        ({"spp": 3}, r"frames of another run \(spp: 2 there, 3 now\): choose another folder with -o"),
        ({"seed": 5}, r"\(seed: 0 there, 5 now\)"),
        ({"text": "value*(1+2*after)"}, r"another sequence \(frame 2 has other values"),
    ):
        other, cases = run_of(loaded, tmp_path, **{"reference": None, **arguments})
        with pytest.raises(InputError, match=message):
            other.run(cases)
    with monkeypatch.context() as patch:
        patch.setattr("mi_neural.__version__", "9.9")
        other, cases = run_of(loaded, tmp_path, reference=None)
        with pytest.raises(InputError, match=r"frames of another run \(version: .* there, 9.9 now\)"):
            other.run(cases)
    twice, cases = run_of(loaded, tmp_path, specs=["path", "path"], reference=None)
    with pytest.raises(InputError, match="would share the folder path"):
        twice.run(cases)


def test_nirc_follows_a_light_that_is_switched_on_and_geometry_that_moves(tmp_path):
    """From a black scene: no crash, no stale acceleration structure, and the mean follows."""
    loaded = load.load_scene("cornell_box", (16, 16), merge=False)
    functions = changes.parse(
        [f"{LAMP}=value*after", "short_block.to_world=translate(0.3*after, 0, 0.1*s) @ value"], 12, 2
    )
    over_time = sequence.Sequence(loaded.scene, functions, 12, 2)
    run = sequence.Run(loaded, over_time, sequence.Plan(spp=16, pretrain=4), tmp_path, 64)
    rows = run.run(benchmark.make_cases(loaded, [parse_integrator("nirc:train_steps=4,train_samples=1024")]))
    rows = rows[0].rows
    assert max(r["mean"] for r in rows[:2]) < 1e-15 and all(r["nonfinite"] == 0 for r in rows)
    means = [run.references.of(k).rgb.mean() for k in range(12)]
    assert rows[11]["mean"] == pytest.approx(means[11], rel=0.25)
    assert rows[11]["relmse_trimmed"] < 0.5


# ---------------------------------------------------------------- plots and figures


def test_summary_tells_before_from_after():
    rows = [{"frame": k, "flip": 0.1 + 0.4 * (k >= 5), "smape": k and 0.2, "relmse_trimmed": 1.0, "seconds": 2.0}
            for k in range(40)]  # fmt: skip
    rows[5]["smape"] = 2.0
    found = plots.summary(rows, 5)
    assert found["flip_before"] == pytest.approx(0.1) and found["flip_first"] == pytest.approx(0.5)
    assert found["flip_late"] == pytest.approx(0.5) and found["flip_area"] == pytest.approx(0.5 * 35)
    assert found["smape_before"] == found["smape_late"] == found["smape_first"] == pytest.approx(0.2)
    assert plots.summary(rows[:20], 5)["flip_late"] is None and plots.summary(rows, None)["flip_before"] is None


def test_crops_are_where_it_changes_and_where_it_does_not(rng):
    before = np.ones((48, 64, 3))
    before[:24, :16] = 0.0  # dark and unchanged: not worth a crop
    after = before * (1 + 0.01 * rng.random((48, 64, 1)))
    after[30:42, 40:56] *= 3.0
    (x, y, w, h), (x2, y2, _, _) = sequence_pictures.choose_crops(before, after)
    assert (x, y, w, h) == (40, 30, 16, 12)
    assert before[y2 : y2 + h, x2 : x2 + w].mean() > 0.4 and (x2 + w <= x or x2 >= x + w or y2 + h <= y or y2 >= y + h)


def test_reliability_is_drawn_where_an_integrator_reports_it(loaded, tmp_path):
    run, cases = run_of(loaded, tmp_path, reference=None)
    result = run.run(cases)[0]
    for row in result.rows:
        row["statistics"] = {"reliability_fast": 0.5, "reliability_ema": 0.9 - 0.2 * row["frame"], "steps": 3}
        frame = result.image(row["frame"])
        weight = {"sigma": np.linspace(0, 1, 256).reshape(16, 16)}
        exr.write(result.folder / f"frame_{row['frame']:04d}.exr", frame.rgb, weight, frame.metadata)
    plots.write(plots.Found(loaded, run, "typed"), tmp_path)
    assert {"reliability.png", "preference.png", "smape.png", "crops.png"} <= {p.name for p in tmp_path.iterdir()}
    assert "Blend weight" in (tmp_path / "report.html").read_text()


# ---------------------------------------------------------------- the command


@pytest.fixture
def command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    register()

    def run(*arguments: object, code: int = 0):
        result = CliRunner().invoke(app, ["sequence", *(str(a) for a in arguments)])
        if result.exception and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert result.exit_code == code, result.output
        return result

    return run


def test_the_command_writes_everything(command):
    arguments = ("cornell_box", "--size", "24x24", "-i", "path", "-i", "fake_cache", "--frames", 6, "--change-at", 3,
                 "--change", "short_block.to_world=translate(0.4*after,0,0)@value", "--reference-spp", 8,
                 "--crop", "0,0,12,12", "--crop", "12,12,12,12", "-o", "out")  # fmt: skip
    result = command(*arguments)
    assert "out/report.html" in result.output and "FLIP before" in result.output
    out = Path("out")
    names = {p.name for p in out.iterdir()}
    assert {"results.json", "table.md", "report.html", "preview.gif", "crops.png", "flip.png", "smape.png", "path",
            "fake_cache", "references"} == names  # fmt: skip
    found = json.loads((out / "results.json").read_text())
    assert found["change"] == 3 and found["changed_keys"] == ["short_block.to_world"]
    assert found["crops"] == [[0, 0, 12, 12], [12, 12, 12, 12]]
    assert [len(c["rows"]) for c in found["cases"]] == [6, 6]
    assert (out / "preview.gif").read_bytes()[:4] == b"GIF8" and "</html>" in (out / "report.html").read_text()

    (out / "path" / "frame_0004.exr").unlink()  # as if interrupted there
    before = (out / "path" / "frame_0001.exr").stat().st_mtime_ns
    command(*arguments)
    assert (out / "path" / "frame_0004.exr").is_file() and len(rows_of(out / "path")) == 6
    assert (out / "path" / "frame_0001.exr").stat().st_mtime_ns == before


@pytest.mark.parametrize("change, merges", [
    ((), [True]), (("--change", "camera.to_world=translate(0.1*frame,0,0)@value"), [False, True]),
    (("--change", "emitter.radiance.value=value*(1-0.2*frame)"), [False]),
])  # fmt: skip
def test_meshes_are_joined_only_where_nothing_but_cameras_changes(command, monkeypatch, change, merges):
    """Joined ones lose their names, and what is done to one of two equal materials would be done to both."""
    found = []

    def load_scene(*arguments, merge=True):
        found.append(merge)
        return known(*arguments, merge=merge)

    known = load.load_scene
    monkeypatch.setattr(load, "load_scene", load_scene)
    monkeypatch.setattr(importlib.import_module("mi_neural.commands.sequence"), "MANY_SHAPES", 1)
    command("cornell_box", "--size", "8x8", "-i", "path", "--frames", 2, "--no-reference", *change, "-o", "out")
    assert found == merges


def test_the_command_without_references_and_when_interrupted(command):
    arguments = ("cornell_box", "--size", "16x12", "-i", "fake_cache", "--frames", 3, "--no-reference", "-o", "out")
    result = command(*arguments[:4], "fake_cache:interrupt_render=3", *arguments[5:], code=130)
    assert "the same command goes on from here" in result.output
    assert len(rows_of(Path("out/fake_cache_interrupt_render-3"))) == 1
    command(*arguments)
    rows = rows_of(Path("out/fake_cache"))
    assert [r["flip"] for r in rows] == [None] * 3 and rows[2]["smape"] > 0
    assert Path("out/crops.png").is_file() and not Path("out/flip.png").exists()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((), "sequence needs a folder for its results: add -o DIR"),
        (("-o", "out", "--frames", "0"), "--frames takes a number of frames from 1, got 0"),
        (("-o", "out", "--change-at", "3"), "add --change KEY=EXPR"),
        (("-o", "out", "--change", "radiance"), "--change takes KEY=EXPR"),
        (("-o", "out", "--change", "a=1", "--change", "a=2"), "--change a is given twice"),
        (("-o", "out", "--change", "a=after", "--frames", "9", "--change-at", "9"), "--change-at 9 is after the end"),
        (("-o", "out", "--change", "lamp.radiance=1"), "close to it: lamp_panel.emitter.radiance.value"),
        (("-o", "out", "--crop", "0,0,99999,1"), "--crop takes x,y,width,height in pixels within 256x256"),
        (("-o", "out", "--no-reference", "--reference-spp", "4"), "exclude each other"),
        (("-o", "out", "--pretrain", "-1"), "--pretrain takes a number of frames from 0"),
        (("-o", "out", "--spp", "0"), "--spp must be greater than 0"),
    ],
)
def test_bad_arguments_are_one_line(command, arguments, message):
    result = command("cornell_box", *arguments, code=2)
    assert message in result.output and len(result.output.strip().splitlines()) == 1
    assert not list(Path(".").rglob("*.exr"))
