"""Live views: frames, weights, what can be moved, hemispheres, maps, widgets without a browser."""

import sys

import drjit as dr
import light_scenes
import mitsuba as mi
import numpy as np
import pytest

import mi_neural
from mi_neural import scenes
from mi_neural.explore import controls, views
from mi_neural.explore.session import Session


def counting(**attributes):
    """An integrator whose n-th image is n everywhere; `trained` counts frames of training."""

    class Counting(mi.SamplingIntegrator):
        def __init__(self, props):
            super().__init__(props)
            self.n = self.trained = 0

        def render(self, scene, sensor, seed=0, spp=0, develop=True, evaluate=True):
            self.n += 1
            width, height = sensor.film().crop_size()
            return dr.full(mi.TensorXf, float(self.n), (int(height), int(width), 3))

        def train(self, scene, frames, sensor=0):
            self.trained += frames

        def statistics(self):
            return {"loss": 1.0 / (1 + self.n)}

        def reset(self):
            self.n = self.trained = 0

    made = Counting(mi.Properties("counting"))
    for name, value in attributes.items():
        setattr(made, name, value)
    return made


def cornell(size=16, **more):
    return mi.load_file(str(scenes.path("cornell_box")), resx=size, resy=size, **more)


@pytest.fixture(scope="module")
def box():
    return cornell()


# ---------------------------------------------------------------- frames


def test_frames_of_what_learns_count_more_and_more(box):
    session = Session(box, counting())
    image = session.run(3)
    assert image.shape == (16, 16, 3)
    np.testing.assert_allclose(image, (1 * 1 + 2 * 2 + 3 * 3) / 6, rtol=1e-6)
    assert session.integrator.trained == 1, "one step, instead of the many of a first image"
    session.restart()
    np.testing.assert_array_equal(session.image, 0)
    np.testing.assert_allclose(session.run(1), 4, rtol=1e-6)


def test_frames_of_what_does_not_learn_count_alike(box):
    np.testing.assert_allclose(Session(box, counting(freeze_cache=True)).run(3), 2.0, rtol=1e-6)


def test_image_of_a_cumulative_integrator_stands_for_itself(box):
    np.testing.assert_allclose(Session(box, counting(cumulative=True)).run(3), 3.0, rtol=1e-6)


def test_reference_holds_until_something_is_moved(box):
    session = Session(box, counting(), reference=np.full((16, 16, 3), 2.0))
    assert np.isnan(session.measure()), "no picture yet"
    session.run(1)
    assert session.measure() == pytest.approx((1 - 2) ** 2 / 4 / (1 + 1e-2), rel=0.01)
    session.turn(azimuth=10)
    session.run(1)
    assert session.moved and np.isnan(session.measure())
    session.home()
    session.run(1)
    assert not session.moved and session.measure() > 0
    assert {name for _, name, _ in session.curve} == {"loss", "trimmed relMSE"}


def test_wrong_input_is_refused(box):
    with pytest.raises(ValueError, match="spp is 0"):
        Session(box, counting(), spp=0)
    with pytest.raises(ValueError, match=r"reference has shape \(4, 4, 3\)"):
        Session(box, counting(), reference=np.zeros((4, 4, 3)))
    with pytest.raises(TypeError, match="integrator is a int"):
        Session(box, 3)
    with pytest.raises(ValueError, match="'width' cannot be set"):
        Session(box, "nirc").set("width", 64)
    with pytest.raises(TypeError, match="cache_samples takes a int"):
        Session(box, "nirc").set("cache_samples", 2.0)


def test_a_key_that_was_set_takes_effect_and_leaves_the_cache():
    session = Session(cornell(), {"type": "nirc", "light_samples": 1, "train_samples": 64})
    session.run(2)
    steps, lit = session.integrator.cache.steps, session.image[:, :8].mean()
    session.set("max_depth", 1)  # emission alone
    session.run(1)
    assert lit > 1e-2 and session.image[:, :4].max() == 0
    session.set("max_depth", -1)
    session.run(1)
    assert session.image[:, :8].mean() > 0.3 * lit
    assert session.integrator.cache.steps > steps


def test_settings_hold_what_an_integrator_has():
    assert [s.name for s in controls.settings(mi.load_dict({"type": "path"}))] == []
    nirc = mi.load_dict({"type": "nirc", "cache_samples": 3})
    found = {s.name: s for s in controls.settings(nirc)}
    assert found["cache_samples"].choices(nirc) == (1, 2, 3, 4, 8, 16)
    assert "termination" in found
    for other in ({"type": "neural_path"}, {"type": "nrc"}):
        assert "termination" not in {s.name for s in controls.settings(mi.load_dict(other))}


# ---------------------------------------------------------------- camera and lights


def place(scene):
    return np.array(scene.sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)


def test_camera_orbits_what_it_looks_at():
    scene = cornell()
    camera = controls.Camera(scene)
    before = place(scene)
    away = before[:3, 3] - camera.target
    np.testing.assert_allclose(camera.target[:2], [0, 1.1], atol=1e-5)
    for azimuth, elevation, distance in ((90, 0, 1), (0, 30, 1), (-40, 20, 2.5)):
        camera.set(azimuth, elevation, distance)
        now = place(scene)
        offset = now[:3, 3] - camera.target
        assert np.linalg.norm(offset) == pytest.approx(distance * np.linalg.norm(away), rel=1e-5)
        np.testing.assert_allclose(now[:3, 2], -offset / np.linalg.norm(offset), atol=1e-5)  # still looks at it
        assert np.degrees(np.arcsin(offset[1] / np.linalg.norm(offset))) == pytest.approx(elevation, abs=1e-3)
    camera.set(0, 0, 1)
    np.testing.assert_allclose(place(scene), before, atol=1e-6)
    assert not camera.moved


def test_camera_stays_off_the_poles():
    scene = cornell()
    camera = controls.Camera(scene)
    camera.set(elevation=120)
    assert camera.elevation == pytest.approx(89)


def test_every_kind_of_light_can_be_changed_as_far_as_it_goes():
    scene = light_scenes.scene_of(light_scenes.MIXED, "envmap")
    lights = {light.name: light for light in controls.lights(scene)}
    assert len(lights) == len(scene.emitters())
    can = {name: (light.can_move, light.can_turn, light.colour is not None) for name, light in lights.items()}
    assert can["spark"][:2] == (True, False)
    assert can["torch"][:2] == (True, True)
    assert can["sun"][:2] == (False, True)
    assert can["sky"] == (False, True, False)
    assert can["window.emitter"] == (True, True, True)
    assert can["box.emitter"][:2] == (True, True)  # a mesh

    params = mi.traverse(scene)
    lights["window.emitter"].set(stops=1, colour=(0.5, 0, 0), offset=(0, 0, 1))
    np.testing.assert_allclose(np.array(params["window.emitter.radiance.value"]).ravel(), [6, 0, 0], atol=1e-5)
    lights["spark"].set(stops=-1, offset=(1, 2, 3))
    np.testing.assert_allclose(np.array(params["spark.position"]).ravel(), [1.5, 2.5, 5.5], atol=1e-5)
    assert float(np.array(params["spark.intensity.value"]).ravel()[0]) == pytest.approx(2)
    for name, light in lights.items():
        before = light.place.value.copy()
        light.set(azimuth=90, elevation=10, offset=(0.1, 0, 0))
        assert light.moved, name
        light.set()
        assert not light.moved, name
        np.testing.assert_array_equal(light.place.value, before)
    lights["sun"].set(azimuth=90)  # about y: x becomes -z
    to = np.array(params["sun.to_world"].matrix, np.float64).reshape(4, 4)[:3, 2]
    np.testing.assert_allclose(to, np.array([-1.0, -0.2, -0.3]) / np.linalg.norm([0.3, 0.2, 1]), atol=1e-5)


# ---------------------------------------------------------------- views


class Directions:
    """A cache whose radiance is (1 + direction) / 2."""

    def encode(self, x, n):
        return None

    def query(self, features, w):
        return mi.Color3f(w + 1) / 2


class Asked:
    queried = Directions()


class Holder:
    cache = Asked()


def test_hemisphere_asks_and_traces_the_same_directions():
    """In the lit cube indirect light is 1/2 from everywhere; a cache of directions shows which were asked."""
    cube = mi.load_file(str(scenes.path("lit_cube")))
    h = views.Hemisphere(cube, Holder(), (32, 32), size=16)
    h.add(32)
    h.add(32)
    y, x = np.mgrid[:16, :16]
    u, v = (x + 0.5) / 8 - 1, 1 - (y + 0.5) / 8
    inside = u**2 + v**2 < 0.85  # no pixel on the rim
    assert h.spp == 64
    np.testing.assert_allclose(h.traced[inside].mean(), 0.5, atol=0.005)  # noise of the mean: 5e-4
    np.testing.assert_array_equal(h.predicted()[u**2 + v**2 >= 1], 0)

    w = 2 * h.predicted() - 1
    np.testing.assert_allclose(np.linalg.norm(w[inside], axis=-1), 1, atol=1e-5)
    cos = w @ np.array(h.normal)
    np.testing.assert_allclose(cos[inside], (1 - u**2 - v**2)[inside], atol=1e-5)
    h.restart()
    assert h.spp == 0


def test_hemisphere_of_nothing_says_so(box):
    with pytest.raises(ValueError, match="outside of the picture"):
        views.Hemisphere(box, Holder(), (16, 0))
    with pytest.raises(views.Unavailable, match="use nirc or nrc"):
        views.Hemisphere(box, mi.load_dict({"type": "path"}), (8, 8)).predicted()
    empty = mi.load_dict({"type": "scene", "s": {"type": "perspective"}, "l": {"type": "constant"}})
    with pytest.raises(views.Unavailable, match="nothing is seen"):
        views.Hemisphere(empty, Holder(), (8, 8))


def test_maps_need_what_they_show(box):
    with pytest.raises(views.Unavailable, match="several lights"):
        views.VisibilityMap(box, mi.load_dict({"type": "path"})).predicted()
    nirc = mi.load_dict({"type": "nirc"})
    with pytest.raises(views.Unavailable, match="use nirc or nrc"):
        views.ReliabilityMap(box, nirc).predicted()


def test_visibility_is_learned_and_traced():
    """Two lamps over a floor; a wall stands between one of them and half of it."""
    t = mi.ScalarTransform4f()
    down = t.rotate([1, 0, 0], 180).scale(0.2)
    scene = mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 60, "to_world": t.look_at([0, 0, 6], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 16, "height": 16}},
        "floor": {"type": "rectangle", "to_world": t.scale(4)},
        "wall": {"type": "rectangle", "to_world": t.rotate([0, 1, 0], 90).scale([2, 4, 1])},
        "a": {"type": "rectangle", "to_world": t.translate([-1.5, 0, 1]) @ down, "emitter": light_scenes.glow()},
        "b": {"type": "rectangle", "to_world": t.translate([1.5, 0, 1]) @ down, "emitter": light_scenes.glow()},
    })  # fmt: skip
    plain = {"type": "plain_path", "max_depth": 2, "light_sampler": {"type": "nvc_lights", "train_frames": 100}}
    session = Session(scene, plain)
    session.run(1)
    shown = []
    for light in (0, 1):
        view = views.VisibilityMap(scene, session.integrator, light)
        with pytest.raises(ValueError, match=r"call add\(\) first"):
            _ = view.traced
        view.add(2)
        assert np.abs(view.predicted() - view.traced).mean() < 0.15
        shown.append(view.traced)
    left, right = (s[:, :7].mean() for s in shown), (s[:, 9:].mean() for s in shown)
    assert sorted(left) == [0, pytest.approx(1, abs=0.15)], "one lamp sees the left half, and only that"
    assert sorted(right) == [0, pytest.approx(1, abs=0.15)]
    with pytest.raises(ValueError, match=r"light is 7; the scene has lights 0\.\.1"):
        views.VisibilityMap(scene, session.integrator, 7).predicted()


# ---------------------------------------------------------------- widgets


def test_widgets_are_not_imported_before_they_are_asked_for(run_python):
    code = "import sys, mi_neural; print([m for m in ('ipywidgets', 'jupyter_rfb') if m in sys.modules])"
    assert run_python(code).stdout.strip() == "[]"


def test_without_widgets_the_error_says_what_to_type(box, monkeypatch):
    monkeypatch.setitem(sys.modules, "jupyter_rfb", None)
    monkeypatch.delitem(sys.modules, "mi_neural.explore.widgets", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'mi_neural\[notebooks\]'"):
        mi_neural.live(box, counting())


@pytest.fixture
def view(capsys):
    pytest.importorskip("jupyter_rfb", reason="needs the extra `notebooks`")
    made = mi_neural.live(cornell(), counting())
    yield made
    made.stop()
    made.close()


def test_view_shows_frames_until_stopped(view):
    frames = [view.canvas.get_frame() for _ in range(3)]
    assert frames[0].shape == (16, 16, 3) and frames[0].dtype == np.uint8
    assert view.session.taken == 4, "one was rendered before the view appeared"
    assert view.rate > 0 and "4 samples a pixel, loss 0.2" in view.status.value
    view.stop()
    view.canvas.get_frame()
    assert view.session.taken == 4 and "stopped" in view.status.value
    view.go()
    view.canvas.get_frame()
    assert view.session.taken == 5


def test_only_one_view_runs(view):
    other = mi_neural.live(cornell(), counting())
    assert other.running and not view.running
    view.go()
    assert view.running and not other.running
    other.close()


def event(kind, x=0, y=0, **more):
    return {"type": kind, "x": x, "y": y, "button": 1, **more}


def test_mouse_orbits_comes_near_and_clicks(view):
    for e in (event("pointer_down", 100, 100), event("pointer_move", 150, 110), event("pointer_up", 150, 110)):
        view.canvas.handle_event(e)
    assert view.session.camera.azimuth == pytest.approx(-20) and view.session.camera.elevation == pytest.approx(4)
    assert view.camera.sliders["azimuth"].value == pytest.approx(-20) and view.session.taken == 0
    view.canvas.handle_event(event("wheel", dx=0, dy=-100))
    assert view.session.camera.distance < 0.95
    assert view.hemisphere is None
    view.home()
    assert not view.session.moved
    for kind in ("pointer_down", "pointer_up"):
        view.canvas.handle_event(event(kind, 240, 400))
    assert view.hemisphere.pixel == (8, 13)
    assert "use nirc or nrc" in view.disks_caption.value and bytes(view.disks.value).startswith(b"\x89PNG")


def test_sliders_change_light_and_keys(view):
    view.canvas.get_frame()
    view.lights.stops.value = 1.0
    assert view.session.moved and view.session.taken == 0
    assert view.session.lights[0].now["stops"] == 1.0
    view.lights.colour.value = "#ff0000"
    np.testing.assert_allclose(view.session.lights[0].now["colour"], [1, 0, 0], atol=1e-6)
    view.home()
    assert not view.session.moved and view.lights.stops.value == 0


def test_what_cannot_be_shown_says_why(view):
    view.show("reliability")
    view.canvas.get_frame()
    assert "use nirc or nrc" in view.disks_caption.value
    with pytest.raises(ValueError, match="there is no view 'nonsense'"):
        view.show("nonsense")


def test_an_error_stops_the_view_and_is_shown(view):
    view.session.integrator.render = None
    with pytest.raises(TypeError):
        view.canvas.get_frame()
    assert not view.running and "TypeError" in view.status.value


def test_readers_without_widgets_see_the_picture(view):
    bundle = view._repr_mimebundle_()
    data = bundle[0] if isinstance(bundle, tuple) else bundle
    assert data["image/png"].startswith(b"\x89PNG") and "application/vnd.jupyter.widget-view+json" in data
