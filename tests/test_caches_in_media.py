"""`nrc`, `neural_path` and `nirc` in participating media: what their caches learn of points in a medium, what paths
without a cache converge to, what is refused."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, sweep
from expectation import assert_mean, assert_same_mean, renders
from media_scenes import ball, cube, everywhere, fog, lamp, rgb, room, smoke, wall

from mi_neural.caches.outgoing import OutgoingTraining, training_paths
from mi_neural.caches.places import Places
from mi_neural.estimators.spread import PathSpread
from mi_neural.render.media import Media
from mi_neural.render.sampling import PathSampler
from mi_neural.render.walk import MediaWalk

HALF_OPEN = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
#: (scene, the integrator that shows the right image).
SCENES = {
    "heterogeneous": (lambda: room(box=cube(smoke())), "volpath"),
    "camera inside": (lambda: everywhere(fog(0.4, 0.8, g=0.4)), "volpath"),
    "colours": (lambda: room(box=cube(fog((0.5, 2.0, 4.0), (0.9, 0.6, 0.8)))), "volpathmis"),
    "in rough glass": (lambda: room(ball=ball(fog(2.0, 0.9), {"type": "roughdielectric", "alpha": 0.3})), "volpath"),
    "half open shell": (lambda: room(box=cube(fog(2.0), HALF_OPEN)), "volpath"),
    "half open walls": (lambda: room(box=cube(fog(), size=0.3), **{
        f"wall{k}": wall((0, 0, 1 + 0.3 * k), (0, 1, 0), 0, bsdf=HALF_OPEN) for k in range(3)}), "volpath"),
}
LIMITS = [{"max_depth": 2}, {"max_depth": 3, "rr_depth": 1}, {"max_depth": 4, "hide_emitters": True}]
OUTGOING = ("nrc", "neural_path")
NAMES = (*OUTGOING, "nirc")
#: Comparisons of this file with a reference; together they fail by chance one choice of seeds in ten thousand.
N_TESTS = len(NAMES) * (len(SCENES) + len(LIMITS)) + 1
DEPTH = {"max_depth": 8}
TRACED = {kind: {"type": kind, "spread_threshold": float("inf"), **DEPTH} for kind in OUTGOING}
TRACED["nirc"] = {"type": "nirc", "cache_samples": 0, **DEPTH}


@pytest.fixture(scope="module")
def known():
    """`known(what, scene, integrator)`: images of the reference, rendered once."""
    found = {}

    def images(what, scene, integrator: dict) -> np.ndarray:
        if what not in found:
            found[what] = renders(scene, integrator, 16, 128, first_seed=500)
        return found[what]

    return images


def compare(what: str, scene, reference: np.ndarray, keys: dict) -> None:
    assert_same_mean(renders(scene, keys, 16, 128), reference, what, blocks=2, relative=1e-4, tests=N_TESTS)


@pytest.mark.parametrize("name, kind", sweep(
    [(name, kind) for name in SCENES for kind in NAMES],
    [("heterogeneous", "nrc"), ("heterogeneous", "neural_path"), ("half open walls", "nrc"), ("in rough glass", "nrc"),
     ("in rough glass", "nirc"), ("colours", "nirc")],
))  # fmt: skip
def test_paths_without_end_show_the_image_of_volpath(name, kind, known):
    make, reference = SCENES[name]
    scene = make()
    images = known(name, scene, {"type": reference, "max_depth": 8})
    compare(f"{name}, {kind}", scene, images, TRACED[kind])


def test_lights_are_chosen_by_a_light_sampler(known):
    scene, sampler = everywhere(fog(0.4)), {"type": "nvc_lights", "train_frames": 8, "train_samples": 256}
    images = known("nvc", scene, {"type": "volpath", "max_depth": 8})
    compare("nvc", scene, images, TRACED["nrc"] | {"light_sampler": sampler})


@pytest.mark.parametrize("limits, kind", sweep(
    [(limits, kind) for limits in LIMITS for kind in NAMES],
    [(LIMITS[1], "nrc"), (LIMITS[2], "neural_path"), (LIMITS[2], "nirc")],
))  # fmt: skip
def test_depths_roulette_and_hidden_emitters_are_those_of_volpath(limits, kind, known):
    scene = room(box=cube(fog(1.5, 0.9)), seen=lamp((0, 0.2, -0.8), rgb(1.0, 2.0, 3.0), 0.2),
                 sky={"type": "constant", "radiance": 0.2})  # fmt: skip
    compare(f"{limits}, {kind}", scene, known(str(limits), scene, {"type": "volpath", **limits}),
            TRACED[kind] | limits)  # fmt: skip


# ---------------------------------------------------------------- what is learned


class Constant:
    """In the place of an outgoing field: it answers `value`, whatever the medium or surface."""

    def __init__(self, value: float):
        self.value, self.box_inv_extent, self.places = value, mi.Vector3f(1), Places(4096)

    def query(self, x, n, w, albedo, roughness):
        return mi.Color3f(self.value) * albedo


def cloud(albedo=1.0) -> mi.Scene:
    """A cloud alone under a sky of radiance 1. With an albedo of 1 all radiance is 1."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])
    return mi.load_dict({"type": "scene", "sky": {"type": "constant", "radiance": 1.0},
                         "cloud": cube(fog(4.0, albedo, g=0.3)),
                         "camera": {"type": "perspective", "fov": 30, "to_world": view, "film": film}})  # fmt: skip


def paths_in(scene, twins=False, n=4096, **constants):
    walk = MediaWalk(Media.of(scene), scene.sensors()[0].get_medium())
    training = OutgoingTraining(n_paths=n, **constants)
    return training, training_paths(
        scene, scene.sensors()[0], Constant(1.0), training, mi.UInt32(3), None, False, twins, walk
    )


@pytest.mark.parametrize("content, known", [("reflected", 1.0), ("indirect", None)])
def test_records_at_scattering_points_hold_what_is_scattered_towards_the_path(content, known):
    """Under a sky of 1, with an albedo of 1, that is 1: direct and indirect light together. One choice of seeds in ten
    thousand fails by chance. Without the direct light it is less, and still positive."""
    training, traced = paths_in(cloud(), content=content)
    records = traced.outgoing
    valid = np.array(records.valid)
    target = np.array(records.target).mean(axis=0)[valid]
    first = np.arange(len(valid))[valid] < training.n_paths  # one of each path: those further along are not independent
    assert first.sum() > 1000
    if known is None:
        assert 0.05 < target[first].mean() < 0.95
    else:
        assert_mean(target[first], known, content)
    inside = np.abs(np.array(records.surface.position).T[valid]).max(axis=1)
    assert (inside < 0.5).all(), "the cloud's boundary has no records"
    assert np.all(np.array(records.surface.albedo).T[valid] == 1)
    np.testing.assert_allclose(np.array(records.surface.normal).T[valid], -np.array(records.surface.view).T[valid])


def test_light_of_long_paths_is_neither_lost_nor_rare():
    """Under a sky of 1, with an albedo of 1, every target is 1 but for the noise of direct light, also where paths have
    hundreds of vertices. With a survival of at most 0.95, and paths given up after 256 vertices, the mean was 0.84 and
    the standard deviation 0.99, now it is 0.46."""
    scene = cloud()
    params = mi.traverse(scene)
    params["cloud.interior_medium.scale"] = 60.0
    params.update()
    _, traced = paths_in(scene, n=512, unbounded_share=1.0)
    target = np.array(traced.outgoing.target).mean(axis=0)[:512][np.array(traced.outgoing.valid)[:512]]
    assert len(target) > 80
    assert_mean(target, 1.0, "long paths")
    assert target.std() < 0.7


def test_no_records_at_rough_glass_around_a_medium():
    """Seen from inside, it has the lobes of what is outside, which the cache does not learn. Other surfaces around a
    medium have records, and so have points in it."""
    box = cube(fog(2.0), {"type": "twosided", "bsdf": {"type": "diffuse"}}, size=0.3, at=(0.6, -0.6, 0))
    glass = ball(fog(8.0, 0.9), {"type": "roughdielectric", "alpha": 0.2}, radius=0.4, at=(-0.3, -0.3, 0))
    _, traced = paths_in(room(ball=glass, box=box))
    records = traced.outgoing
    position = np.array(records.surface.position).T[np.array(records.valid)]
    distance = np.linalg.norm(position - np.array([-0.3, -0.3, 0]), axis=1)
    inside = (distance < 0.399).sum()
    assert inside > 500
    assert (np.abs(distance - 0.4) < 1e-4).sum() < 0.02 * inside, "on the ball: points in it by chance alone"
    on_box = np.abs(np.abs(position - np.array([0.6, -0.6, 0])).max(axis=1) - 0.3) < 1e-4
    assert on_box.sum() > 100


def test_twins_cost_no_more_kernels_than_paths_alone():
    """The rays of twins are followed once, not once for each part of a path's state."""
    scene = cloud()

    def kernels(twins) -> int:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(paths_in(scene, twins, n=64)[1])
            return sum(k["type"] == dr.KernelType.JIT for k in dr.kernel_history())

    assert kernels(True) <= kernels(False) + 4


def test_share_of_paths_without_an_end_in_media():
    """In media all, unless a key says it; of images of `neural_path` that no denoiser will see, a quarter."""
    clear, foggy = room(), room(box=cube(fog()))

    def share(scene, **keys):
        integrator = mi.load_dict(keys)
        integrator.bind(scene, scene.sensors()[0], train=False)
        return integrator.cache.training.unbounded_share

    denoised = {"type": "neural_path", "denoised": True}
    assert [share(foggy, type="nrc"), share(foggy, type="neural_path"), share(foggy, **denoised)] == [1, 0.25, 1]
    assert share(foggy, type="nrc", unbounded_share=0.1) == 0.1
    assert [share(clear, type="nrc"), share(clear, **denoised)] == [0.25, 0.5]


def test_twins_start_at_one_point_and_go_their_own_ways():
    training, traced = paths_in(cloud(), twins=True)
    position = np.array(traced.outgoing.surface.position).T[: 2 * training.n_paths]
    valid = np.array(traced.outgoing.valid)[: 2 * training.n_paths]
    first, second = position[: training.n_paths], position[training.n_paths :]
    assert valid[: training.n_paths].any()
    np.testing.assert_array_equal(first[::2], first[1::2])
    both = valid[training.n_paths :][::2] & valid[training.n_paths :][1::2]
    assert both.sum() > 500 and (np.abs(second[::2] - second[1::2]).max(axis=1)[both] > 0).all()


@pytest.mark.parametrize("albedo, kind", sweep(
    [(albedo, kind) for albedo in (1.0, 0.8) for kind in OUTGOING], [(1.0, "nrc"), (0.8, "neural_path")]
))  # fmt: skip
def test_cloud_seen_in_the_cache(kind, albedo):
    """The cache alone, at the first vertex: 1 everywhere where the albedo is 1, else the image of `volpath`."""
    scene = cloud(albedo)
    integrator = mi.load_dict({"type": kind, "spread_threshold": 0.0, "train_frames": 96, "train_steps": 0,
                               "train_samples": 1024, "channels": "cache, cached, traced", **NETWORK})  # fmt: skip
    images = np.array([mi.render(scene, integrator=integrator, spp=64, seed=k) for k in range(2)], np.float64)
    middle = np.s_[:, 3:5, 3:5]
    expected = 1.0 if albedo == 1 else renders(scene, {"type": "volpath"}, 4, 256)[middle].mean()
    assert abs(images[middle][..., :3].mean() / expected - 1) < 0.05
    assert integrator.statistics()["nonfinite"] == 0
    cached = images[..., 6:9] if kind == "nrc" else images[..., 3:6]
    assert cached[middle].mean() > 0.3 * expected, "the cache was seen"
    assert np.isfinite(images).all()


def test_spread_in_a_medium_has_no_angle():
    """Of one segment of length 2 and density 1/4π: ``a = 4 / (1/4π)``; a_0 at the distance 3: ``9 / 4π``."""
    no, yes = mi.Bool(False), mi.Bool(True)
    spread = PathSpread.start(1).reach(mi.Float(3), mi.Float(1), mi.Float(1), yes, yes, yes)
    spread = spread.reach(mi.Float(2), mi.Float(1), mi.Float(1 / (4 * np.pi)), no, yes, yes)
    np.testing.assert_allclose([spread.a_0[0], spread.root[0] ** 2], [9 / (4 * np.pi), 16 * np.pi], rtol=1e-5)


# ---------------------------------------------------------------- what leaves the view


def two_clouds() -> mi.Scene:
    """Under a sky of radiance 1 two clouds with a camera each, one of albedo 1, and one that is dense and black, with
    its camera inside, which sees nothing else."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    T = mi.ScalarTransform4f
    black = fog(40.0, 0.0) | {"id": "black"}
    return mi.load_dict({
        "type": "scene", "sky": {"type": "constant", "radiance": 1.0}, "black": black,
        "dark": {"type": "cube", "bsdf": {"type": "null"}, "to_world": T().translate([8, 0, 0]),
                 "interior": {"type": "ref", "id": "black"}},
        "cloud": cube(fog(4.0, 1.0, g=0.3)),
        "ball": {"type": "sphere", "radius": 0.2, "bsdf": {"type": "diffuse", "reflectance": 1.0}},
        "here": {"type": "perspective", "fov": 30, "film": film,
                 "to_world": T().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])},
        "there": {"type": "perspective", "fov": 30, "film": film, "medium": {"type": "ref", "id": "black"},
                  "to_world": T().look_at([8, 0, 0], [8, 0, 1], [0, 1, 0])},
    })  # fmt: skip


@pytest.mark.parametrize("twins", [False, True])
def test_paths_start_where_records_lay_that_are_out_of_view(twins):
    """At points of the white cloud, and on the white ball in it, all light is 1, wherever the camera is now: a path
    goes on in the medium that the place is in, not in that of the camera. One choice of seeds in ten thousand fails by
    chance."""
    scene = two_clouds()
    here, there = scene.sensors()
    walk = MediaWalk(Media.of(scene, [here, there]))
    away = MediaWalk(walk.media, there.get_medium())
    field, training = Constant(1.0), OutgoingTraining(n_paths=4096, world_share=0.5)
    args = training, mi.UInt32(3), None, False, twins
    records = training_paths(scene, here, field, *args, walk).outgoing
    dr.eval(records)
    surface = records.surface
    for k in range(16):
        sampler = PathSampler.make(dr.arange(mi.UInt32, 4096), mi.UInt32(k))
        field.places.remember(surface.position, surface.view, records.valid, sampler, records.inside)
    places = np.array(field.places.position).T
    known = np.isfinite(places).all(axis=1)
    on_ball = np.abs(np.linalg.norm(places, axis=1) - 0.2) < 1e-3

    records = training_paths(scene, there, field, *args, away).outgoing
    position, valid = np.array(records.surface.position).T, np.array(records.valid)
    first = np.arange(len(valid)) < 4096
    back = valid & first & (np.abs(position).max(axis=1) < 0.5)
    assert back[:4096].mean() > 0.3, "paths start in the white cloud"
    norm = np.linalg.norm(position, axis=1)
    assert abs((np.abs(norm[back] - 0.2) < 1e-3).mean() - on_ball[known].mean()) < 0.05
    kinds = {tuple(p) for p in np.round(places[known], 4)}
    assert np.mean([tuple(p) in kinds for p in np.round(position[back], 4)]) > 0.9, "at the places that were met"
    target = np.array(records.target).mean(axis=0)
    if not twins:
        assert_mean(target[back & (norm > 0.2001)], 1.0, "in the cloud")
        assert_mean(target[back & (np.abs(norm - 0.2) < 1e-3)], 1.0, "on the ball")


def two_rooms() -> mi.Scene:
    """Two closed cubes full of fog with a camera and a lamp each: no path leads from one to the other."""
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    T = mi.ScalarTransform4f
    grey = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    parts = {"air": fog(0.6, 0.9) | {"id": "air"}}
    air = {"type": "ref", "id": "air"}
    for k, x in enumerate((-1.2, 1.2)):
        parts[f"room{k}"] = {"type": "cube", "bsdf": grey, "to_world": T().translate([x, 0, 0]), "interior": air}
        parts[f"lamp{k}"] = {"type": "point", "position": [x, 0.5, 0], "intensity": 0.5 + k}
        look_at = T().look_at([x, -0.3, 0.9], [x, 0, -1], [0, 1, 0])
        parts[f"sensor{k}"] = {"type": "perspective", "fov": 70, "to_world": look_at, "film": film, "medium": air}
    return mi.load_dict({"type": "scene", **parts})


@pytest.mark.parametrize("kind", sweep(OUTGOING, ("nrc",)))
def test_what_leaves_the_view_is_not_forgotten(kind):
    """Trained in one foggy room, then in the other: with places out of view the cache's answers in the first, at
    points of the fog and on its walls, stay what they were. When the camera stays, they change by 0.09."""
    scene = two_rooms()
    here, there = scene.sensors()
    _, traced = paths_in(scene, n=1024)
    records = traced.outgoing
    seen = np.flatnonzero(np.array(records.valid)[:1024])
    asked = dr.gather(type(records.surface), records.surface, mi.UInt32(seen))
    changed = {}
    for share in (0.0, 0.5):
        integrator = mi.load_dict({"type": kind, "world_share": share, "train_samples": 512, "train_frames": 0,
                                   "learning_rate": 0.03})  # fmt: skip

        found = []
        for sensor in (here, there):
            integrator.train(scene, 60, sensor=sensor)
            found.append(np.array(integrator.cache.field.query(*asked.inputs())).mean(axis=0))
        changed[share] = np.abs(found[1] - found[0]).mean() / found[0].mean()
    print(f"{kind}: change of the answers in the room that was left: {changed}")
    assert changed[0.5] < 0.25 and changed[0.5] < 0.5 * changed[0.0]


# ---------------------------------------------------------------- edits, recordings, refusals


@pytest.mark.parametrize("kind", sweep(NAMES, ("neural_path",)))
def test_another_medium_another_camera_and_a_scene_without_media(kind):
    """Recorded functions know of each; images of one kind are recorded once."""
    keys = {"type": kind, "train_frames": 8, "train_samples": 256, "max_depth": 6, **NETWORK}
    integrator = mi.load_dict(keys)

    def mean(scene, n=3):
        return float(np.mean([np.array(mi.render(scene, integrator=integrator, spp=64, seed=k)) for k in range(n)]))

    thin, clear, inside = room(box=cube(fog(1e-3))), room(), everywhere(fog(2.0))
    light = mean(clear)
    assert abs(mean(thin) / light - 1) < 0.15
    assert mean(inside) < 0.7 * light
    integrator.reset()
    mean(thin, 4)
    before = dict(integrator.cache.recordings())
    mean(thin)
    assert integrator.cache.recordings() == before
    params = mi.traverse(thin)
    params["box.interior_medium.scale"] = 200.0
    params["box.interior_medium.albedo.value.value"] = 0.0
    params.update()
    integrator.reset()
    assert mean(thin) < 0.9 * light


@pytest.mark.parametrize("kind", OUTGOING)
def test_roughening_is_refused_in_media(kind):
    refused = mi.load_dict({"type": kind, "roughening": 0.5})
    for _ in range(2):  # the second time, too
        with pytest.raises(ValueError, match="roughening works in scenes without participating media; leave it out"):
            refused.render(room(box=cube(fog())), spp=1)


@pytest.mark.parametrize("kind", NAMES)
def test_gradients_are_refused_in_media(kind):
    scene = room(box=cube(fog()))
    integrator, params = mi.load_dict({"type": kind, "train_frames": 1, **NETWORK}), mi.traverse(scene)
    key = "floor.bsdf.reflectance.value"
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(RuntimeError, match=r"there are no gradients.*participating media.*'prbvolpath'"):
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=1), axis=None))
