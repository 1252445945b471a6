"""What users do with ``path``, with each integrator of this package: sensors, wrappers, coverage.
`test_user_scripts.py` has loops, threads and bad input.

Mitsuba's `path` is the reference. Comparisons of means allow for four standard errors and, where a cache ends paths,
for 8 % of bias: a false alarm in about 10,000 choices of seed.
"""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, SLOW, sweep

from mi_neural.render.film import Area, put_in_reach

T = mi.ScalarTransform4f
SMALL = {"train_frames": 32, "train_samples": 512, **NETWORK}
INTEGRATORS = {
    "plain_path": {"type": "plain_path"},
    "nirc": {"type": "nirc", **SMALL},
    "nrc": {"type": "nrc", **SMALL},
    "neural_path": {"type": "neural_path", **SMALL},
    "nirc_two_level": {"type": "nirc_two_level", **SMALL},
}
UNBIASED = ("plain_path", "nirc_two_level")
CACHED = tuple(n for n in INTEGRATORS if n != "plain_path")
ALL = pytest.mark.parametrize("name", INTEGRATORS)
#: For tests of what all integrators inherit: one without a cache and one with.
TWO = pytest.mark.parametrize("name", sweep(INTEGRATORS, ("plain_path", "nrc")))


def grey(value):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value] * 3}}


def wall(at, axis=(0, 1, 0), angle=0.0, size=1.0, **keys):
    return {"type": "rectangle", "to_world": T().translate(list(at)).rotate(list(axis), angle).scale(size), **keys}


def film(width=12, height=12, **keys):
    return {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, **keys}


def camera(origin=(0, 0, 3.2), target=(0, 0, 0), kind="perspective", **keys):
    keys = {"film": film(), **keys} | ({} if kind == "orthographic" else {"fov": 45})
    return {"type": kind, "to_world": T().look_at(list(origin), list(target), [0, 1, 0]), **keys}


def room(**changes):
    """An open box with a cube in it and a lamp under its ceiling; an entry that is None is left out."""
    parts = {
        "type": "scene", "sensor": camera(), "back": wall((0, 0, -1), bsdf=grey(0.6)),
        "floor": wall((0, -1, 0), (1, 0, 0), -90, bsdf=grey(0.6)),
        "ceiling": wall((0, 1, 0), (1, 0, 0), 90, bsdf=grey(0.6)),
        "left": wall((-1, 0, 0), (0, 1, 0), 90, bsdf=grey(0.6)),
        "right": wall((1, 0, 0), (0, 1, 0), -90, bsdf=grey(0.3)),
        "block": {"type": "cube", "to_world": T().translate([0.3, -0.7, 0.1]).scale(0.3), "bsdf": grey(0.6)},
        "lamp": wall((0, 0.98, 0), (1, 0, 0), 90, 0.3, bsdf=grey(0.0), emitter={"type": "area", "radiance": 5.0}),
        **changes,
    }  # fmt: skip
    return mi.load_dict({k: v for k, v in parts.items() if v is not None})


def images(scene, keys, sensor=0, spp=64, n=4, first=0):
    integrator = mi.load_dict(keys) if isinstance(keys, dict) else keys
    return np.array([
        np.array(mi.render(scene, integrator=integrator, sensor=sensor, spp=spp, seed=first + k)) for k in range(n)
    ], np.float64)  # fmt: skip


def agree(name, ours, path, channels=slice(0, 3)):
    """The mean of images by `name` against that of images by ``path``."""
    assert ours.shape == path.shape and np.isfinite(ours).all()
    a, b = (x[..., channels].mean(axis=(1, 2, 3)) for x in (ours, path))
    error = np.hypot(a.std(ddof=1), b.std(ddof=1)) / len(a) ** 0.5
    allowed = max(4 * error, (0.005 if name in UNBIASED else 0.08) * abs(b.mean()), 1e-6)
    print(f"{name}: {a.mean():.5f}, path {b.mean():.5f}, allowed {allowed:.5f}")
    assert abs(a.mean() - b.mean()) <= allowed


# ---------------------------------------------------------------- sensors


@TWO
def test_sensor_that_is_not_in_the_scene(name):
    scene, integrator = room(sensor=None), mi.load_dict(INTEGRATORS[name])
    for x in (-1.0, 1.0):
        view = mi.load_dict(camera((x, 0.2, 3.0)))
        agree(name, images(scene, integrator, view), images(scene, {"type": "path"}, view, first=100))


@pytest.mark.parametrize("kind, keys", [("thinlens", {"aperture_radius": 0.05, "focus_distance": 3.0}),
                                        ("orthographic", {})])  # fmt: skip
@pytest.mark.parametrize("name", ["plain_path", "nrc"])
def test_sensors_that_cannot_be_recorded_render_from_recorded_functions(name, kind, keys):
    scene, integrator = room(sensor=camera(kind=kind, **keys)), mi.load_dict(INTEGRATORS[name])
    agree(name, images(scene, integrator), images(scene, {"type": "path"}, first=100))
    recorded = [f.n_recordings for f in integrator.film_state.passes.recorded.values()]
    images(scene, integrator, first=50)
    assert [f.n_recordings for f in integrator.film_state.passes.recorded.values()] == recorded and max(recorded) <= 3


@pytest.mark.parametrize("name", ["plain_path", "nirc"])
def test_irradiance_meter(name):
    def meter(x, count):  # equal sensors would be merged into one by Mitsuba 3.9.1
        sensor = {"type": "irradiancemeter", "film": film(1, 1),
                  "sampler": {"type": "independent", "sample_count": count}}  # fmt: skip
        return wall((x, -0.99, 0.5), (1, 0, 0), -90, 0.1, bsdf=grey(0.0), sensor=sensor)

    scene = room(sensor=None, a=meter(-0.5, 4), b=meter(0.5, 5))
    if name != "plain_path":  # whose plan looks at two lamps
        second = wall((0.5, 0.9, 0), (1, 0, 0), 90, 0.1, emitter={"type": "area"})
        made = mi.load_dict(INTEGRATORS[name]).make_plan(room(sensor=None, a=meter(-0.5, 4), second=second))
        assert "chosen uniformly" in made.decisions["light_sampler"].because
    for k in range(2):
        agree(name, images(scene, INTEGRATORS[name], k, 4096), images(scene, {"type": "path"}, k, 4096, first=100))


@pytest.mark.parametrize("name", ["plain_path", pytest.param("nirc", marks=SLOW)])
def test_batch(name):
    view = {k: v for k, v in camera().items() if k != "film"}
    scene = room(sensor={"type": "batch", "a": view, "b": {**view, "fov": 20}, "film": film(24, 12)})
    agree(name, images(scene, INTEGRATORS[name]), images(scene, {"type": "path"}, first=100))


@pytest.mark.parametrize("keys", [{"type": "plain_path", "max_depth": 2}, {"type": "restir_di"}])
def test_batch_sensor_that_was_asked_for_rays_before(keys):
    """It keeps numbers of the last rays, and the process ended where a recording freed them."""
    view = {k: v for k, v in camera().items() if k != "film"}
    scene = room(sensor={"type": "batch", "a": view, "b": {**view, "fov": 20}, "film": film(16, 8)})
    places = mi.Point2f(np.float32([0.2, 0.7]), np.float32([0.3, 0.4]))
    dr.eval(scene.sensors()[0].sample_ray_differential(0.0, 0.5, places, mi.Point2f(0.5)))
    path = images(scene, {"type": "path", "max_depth": 2}, spp=256, n=1).mean()
    assert abs(images(scene, keys, spp=32, n=1).mean() / path - 1) < 0.1


def test_one_recording_serves_many_views():
    scene, integrator = room(sensor=None), mi.load_dict(INTEGRATORS["plain_path"])
    for k in range(6):
        view = mi.load_dict(camera((0.2 * k, 0, 3.0), fov=40 + k) if k % 2 else camera((0.2 * k, 0, 3.0)))
        path = images(scene, {"type": "path"}, view, 256, 1)
        assert abs(images(scene, integrator, view, 256, 1).mean() / path.mean() - 1) < 0.06
    passes = integrator.film_state.passes.recorded
    assert len(passes) == 1 and max(f.n_recordings for f in passes.values()) <= 3


def test_crop_window_that_moves_is_no_new_recording():
    scene, integrator = room(), mi.load_dict(INTEGRATORS["plain_path"])
    whole = images(scene, integrator, spp=256, n=1)[0]
    for x in (0, 4, 8):
        view = mi.load_dict(camera(film=film(crop_width=4, crop_height=12, crop_offset_x=x, crop_offset_y=0)))
        part = images(scene, integrator, view, 256, 1)[0]
        assert abs(part.mean() / whole[:, x : x + 4].mean() - 1) < 0.1
    assert len(integrator.film_state.passes.recorded) == 2


@pytest.mark.parametrize("keys", [{"type": "plain_path", "max_depth": 2}, {"type": "restir_di"}])
def test_samples_in_the_border_that_reach_no_pixel(keys):
    """Mitsuba wrote beside the image for them, and the process ended."""
    lanczos = {"rfilter": {"type": "lanczos"}, "sample_border": True}
    view = camera(film=film(8, 4, **lanczos))
    assert np.isfinite(images(room(sensor=view), keys, spp=16, n=4)).all()
    area = Area.of(mi.load_dict(view))
    places = mi.Point2f([-2.9, -2.4, 10.6, 4.0], [1.0, 1.0, 1.0, 6.6])
    assert (area.border, area.radius) == (3, 3.0) and list(area.reaches(places)) == [False, True, False, False]
    place, (one,) = put_in_reach(area, places, [mi.Float(1)])
    assert list(one) == [0, 1, 0, 0] and np.array(place)[:, 0].tolist() == [0.5, 0.5]


# ---------------------------------------------------------------- coverage and what is hidden


#: Side by side, each in a third of the picture: a mask in front of nothing, a boundary that is none, and glass.
THIRDS = {
    "mask": {"type": "rectangle", "to_world": T().translate([-2.65, 0, 0.9]).scale(0.6),
             "bsdf": {"type": "mask", "opacity": 0.4, "bsdf": grey(0.5)}},
    "null": {"type": "sphere", "radius": 0.5, "bsdf": {"type": "null"}},
    "glass": {"type": "sphere", "center": [2.65, 0, 0], "radius": 0.5, "bsdf": {"type": "dielectric"}},
}  # fmt: skip
WIDE = {
    "back": None, "left": None, "right": None, "block": None,
    "floor": wall((1.3, -1, 0), (1, 0, 0), -90, 2.5, bsdf=grey(0.6)),
    "ceiling": wall((1.3, 1, 0), (1, 0, 0), 90, 2.5, bsdf=grey(0.6)),
    "lamp": wall((0, 0.98, 0), (1, 0, 0), 90, bsdf=grey(0.0), emitter={"type": "area", "radiance": 2.0}),
}  # fmt: skip
#: What is in the scene, and the parts of the picture that are looked at one by one.
COVERAGE = {
    "thirds": ({**WIDE, **THIRDS}, 3),
    "black sky": ({"sky": {"type": "constant", "radiance": 0.0}, "back": None}, 1),
    "sky": ({"sky": {"type": "constant", "radiance": 0.3}, "back": None}, 1),
}


@pytest.fixture(scope="module")
def of_path():
    """`of_path(what, scene, ...)`: images by ``path``, rendered once."""
    found = {}

    def rendered(what, scene, **keys):
        if what not in found:
            found[what] = images(scene, {"type": "path", **keys}, spp=64, first=100)
        return found[what]

    return rendered


@pytest.mark.parametrize("name, case, hide", sweep(
    itertools.product(INTEGRATORS, COVERAGE, (False, True)),
    [*itertools.product(["plain_path"], COVERAGE, (False, True)), ("nirc", "thirds", True), ("nrc", "thirds", True)],
))  # fmt: skip
def test_coverage_is_that_of_path(name, case, hide, of_path):
    parts, n = COVERAGE[case]
    scene = room(sensor=camera(film=film(12 * n, pixel_format="rgba"), fov_axis="y"), **parts)
    ours = images(scene, {**INTEGRATORS[name], "hide_emitters": hide}, spp=64)
    path = of_path((case, hide), scene, hide_emitters=hide)
    for a, b in zip(np.split(ours, n, axis=2), np.split(path, n, axis=2), strict=True):
        agree(name, a, b)
        a, b = a[..., 3].mean(axis=0), b[..., 3].mean(axis=0)
        # 256 samples of a share of at most 1/4 of variance each: 4.9 standard errors of the difference
        assert np.abs(a - b).max() < 0.22 and abs(a.mean() - b.mean()) < 0.02


@pytest.mark.parametrize("name", sweep(CACHED, ("nirc", "nrc")))
def test_mirror_behind_a_hidden_lamp(name):
    mirror = wall((0, 0, -0.95), size=0.6, bsdf={"type": "twosided", "bsdf": {"type": "conductor"}})
    ball = {"type": "sphere", "center": [0, 0, 0.4], "radius": 0.2, "emitter": {"type": "area", "radiance": 3.0}}
    scene = room(mirror=mirror, ball=ball)
    path, ours = (images(scene, {**keys, "hide_emitters": True}, spp=256, n=2)[:, 4:8, 4:8].mean() for keys in
                  ({"type": "path"}, INTEGRATORS[name]))  # fmt: skip
    print(f"behind the lamp {ours / path - 1:+.1%}")
    assert abs(ours / path - 1) < 0.1


@pytest.mark.parametrize("name", UNBIASED)
def test_roulette_begins_where_it_does_in_path(name):
    """With roulette from the first bounce on: the mean, and the spread between images, are those of ``path``."""
    scene = room()
    ours = images(scene, {**INTEGRATORS[name], "rr_depth": 1}, n=12, spp=16)
    path = images(scene, {"type": "path", "rr_depth": 1}, n=12, spp=16, first=100)
    agree(name, ours, path)


# ---------------------------------------------------------------- wrappers


@pytest.mark.parametrize("name", [pytest.param("nirc", marks=SLOW), "nrc"])
def test_wrappers_train_for_the_sensor_that_renders(name):
    """Two rooms, the first sensor in the other one: a cache trained there knows nothing of this one."""
    def rooms(x, tint, n):
        parts = {f"{k}{n}": wall((x + p[0], *p[1:]), a, d, bsdf=grey(0.6)) for k, p, a, d in (
            ("back", (0, 0, -1), (0, 1, 0), 0), ("front", (0, 0, 1), (0, 1, 0), 180),
            ("floor", (0, -1, 0), (1, 0, 0), -90), ("ceiling", (0, 1, 0), (1, 0, 0), 90),
            ("left", (-1, 0, 0), (0, 1, 0), 90), ("right", (1, 0, 0), (0, 1, 0), -90))}  # fmt: skip
        lamp = {"type": "area", "radiance": {"type": "rgb", "value": tint}}
        parts[f"lamp{n}"] = wall((x, 0.98, 0), (1, 0, 0), 90, 0.3, bsdf=grey(0.0), emitter=lamp)
        return parts | {f"view{n}": camera((x, 0, 0.9), (x, 0, -1), film=film())}

    scene = mi.load_dict({"type": "scene", **rooms(0.0, [5, 1, 1], 0), **rooms(8.0, [1, 1, 8], 1)})
    wrapped = {"type": "aov", "aovs": "d:depth", "image": INTEGRATORS[name]}
    path = images(scene, {"type": "path"}, 1, 256, 2)
    ours = images(scene, wrapped, 1, 64, 2)[..., :3]
    print(f"{ours.mean() / path.mean() - 1:+.2%}")
    assert abs(ours.mean() / path.mean() - 1) < 0.06
    view = mi.load_dict(camera((8, 0, 0.9), (8, 0, -1)))
    loose = images(scene, {"type": "moment", "inner": INTEGRATORS[name]}, view, spp=4, n=2)
    assert np.isfinite(loose).all()
