"""The visibility cache: what it learns, and how."""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from expectation import renders
from light_scenes import glow
from test_light_samplers import SAMPLERS, path_with

from mi_neural.caches import visibility
from mi_neural.caches.visibility import VisibilityCache, VisibilityField, VisibilityTraining, surface_point
from mi_neural.caches.weights import FieldShape
from mi_neural.lights.clusters import make_groups
from mi_neural.lights.table import LightTable


def wall_scene():
    """A floor, a wall at x = 0, a light on either side of it, and one above."""
    up = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    wall = mi.ScalarTransform4f().translate([0, 1.5, 0]).scale([0.05, 1.5, 2])
    return mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 60, "to_world": mi.ScalarTransform4f().look_at([0, 7, 0], [0, 0, 0],
            [0, 0, 1]),
                   "film": {"type": "hdrfilm", "width": 16, "height": 16}},
        "floor": {"type": "rectangle", "to_world": up.scale(2)},
        "wall": {"type": "cube", "to_world": wall},
        "left": {"type": "point", "position": [-1.5, 1, 0], "intensity": 1.0},
        "right": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([1.5, 1, 0]).scale(0.1),
            "emitter": glow()},
        "ball": {"type": "sphere", "center": [1.2, 1, 1], "radius": 0.3, "emitter": glow()},
        "tube": {"type": "cylinder", "p0": [1, 0.5, -1], "p1": [1, 1.5, -1], "radius": 0.2, "emitter": glow()},
    })  # fmt: skip


def order(scene, table) -> list[str]:
    names = [e.get_shape().id() if e.get_shape() else e.id() for e in scene.emitters()]
    return [names[k] for k in table.columns["emitter"]]


def known_visibility(scene, table, p: np.ndarray) -> np.ndarray:
    """Share of each light's samples that are seen from the points (n, 3): (lights, n)."""
    n, m = len(p), 64
    si = dr.zeros(mi.SurfaceInteraction3f, n * m)
    si.p = mi.Point3f(*np.repeat(p, m, axis=0).T)
    u = mi.Point2f(*np.random.default_rng(0).random((2, n * m), np.float32))
    out = []
    for k in range(table.n_lights):
        emitter = scene.emitters()[int(table.columns["emitter"][k])]
        ds, _ = emitter.sample_direction(si, u)
        distance = dr.norm(mi.Point3f(ds.p) - si.p)
        ray = mi.Ray3f(si.p, ds.d)
        ray.maxt = distance * (1 - 1e-3)
        seen = ~scene.ray_test(ray)
        out.append((np.array(seen) * np.ones(n * m)).reshape(n, m).mean(axis=1))
    return np.array(out)


@pytest.fixture(scope="module")
def wall():
    scene = wall_scene()
    table = LightTable(scene)
    cache = VisibilityCache(VisibilityTraining(n_points=4096))
    losses = []
    for _ in range(100):
        cache.train(scene, scene.sensors()[0], table, make_groups(table, 32))
        losses.append(cache.statistics["visibility_loss"])
    return scene, table, cache, losses


def said(cache, p) -> np.ndarray:
    return np.array([np.array(v) for v in cache.field.query(mi.Point3f(*np.asarray(p, np.float32).T))])


def test_network_learns_which_side_of_a_wall_sees_a_light(wall):
    scene, table, cache, _ = wall
    rng = np.random.default_rng(1)
    p = np.stack([rng.uniform(0.4, 1.8, 400), np.full(400, 0.01), rng.uniform(-1, 1, 400)], -1)
    p[:200, 0] *= -1
    found = dict(zip(order(scene, table), said(cache, p), strict=False))
    left = p[:, 0] < 0
    print({k: (f"{v[left].mean():.3f}", f"{v[~left].mean():.3f}") for k, v in found.items()})
    assert found["left"][left].mean() > 0.95 and found["left"][~left].mean() < 0.05
    assert found["right"][~left].mean() > 0.9 and found["right"][left].mean() < 0.05


def test_network_has_a_small_error_for_lights_of_every_kind(wall):
    """Spheres and cylinders hide their own middle, which is not to count as hidden. Of a cylinder Mitsuba samples the
    far side as well, which the cylinder itself hides: its share lies below what can be seen."""
    scene, table, cache, _ = wall
    rng = np.random.default_rng(2)
    p = np.stack(
        [rng.uniform(0.3, 1.8, 300) * rng.choice([-1, 1], 300), np.full(300, 0.01), rng.uniform(-1.8, 1.8, 300)], -1
    )
    known, found = known_visibility(scene, table, p), said(cache, p)
    error = dict(zip(order(scene, table), np.sqrt(((known > 0) - found).__pow__(2).mean(axis=1)), strict=False))
    share = dict(zip(order(scene, table), (known > 0).mean(axis=1), strict=False))
    print("rms errors", {k: f"{v:.3f} (of {share[k]:.2f})" for k, v in error.items()})
    assert max(v for k, v in error.items() if k != "tube") < 0.1 and error["tube"] < 0.5


def test_loss_falls(wall):
    losses = np.array(wall[3])
    print(f"first {losses[:3].mean():.3f}, last {losses[-10:].mean():.4f}")
    assert losses[-10:].mean() < 0.2 * losses[:3].mean() and np.isfinite(losses).all()


def test_statistics_count_the_steps(wall):
    s = wall[2].statistics
    assert s["visibility_steps"] == wall[2].steps == 100 and s["seconds_visibility"] > 0


def test_time_of_training_is_counted_once():
    """A clock that ticks at each reading: reading what the steps found is within the time of training."""
    scene = wall_scene()
    table = LightTable(scene)
    cache = VisibilityCache(VisibilityTraining(n_points=64))
    cache.train(scene, scene.sensors()[0], table, make_groups(table, 32))
    before, ticks = cache.statistics["seconds_visibility"], itertools.count()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("time.perf_counter", lambda: float(next(ticks)))
        cache.train(scene, scene.sensors()[0], table, make_groups(table, 32), frames=16)
        passed = next(ticks)
    assert 0 < cache.statistics["seconds_visibility"] - before < passed


def test_equal_seeds_give_equal_weights_and_others_do_not():
    scene = wall_scene()
    table = LightTable(scene)

    def weights(seed):
        cache = VisibilityCache(VisibilityTraining(n_points=512), seed=seed)
        cache.train(scene, scene.sensors()[0], table, make_groups(table, 32), frames=8)
        return {k: np.array(v, np.float64) for k, v in cache.field.averaged.parameters().items()}

    a, b, c = weights(1), weights(1), weights(2)
    rms = [np.sqrt(np.mean(np.concatenate([(a[k] - x[k]).ravel() for k in a]) ** 2)) for x in (b, c)]
    print(f"rms difference: equal seeds {rms[0]:.1e}, other seeds {rms[1]:.1e}")
    assert rms[0] < 0.1 * rms[1]


def cells_scene(n=6):
    """`n` x `n` cells between walls, seen from above, a lamp in each: no cell sees the lamp of another. Returns (scene,
    a point in the cell of each emitter)."""
    T, bounds = mi.ScalarTransform4f, np.arange(n + 1) - n / 2
    walls = {f"x{k}": T().translate([b, 1, 0]).scale([0.02, 1, n / 2]) for k, b in enumerate(bounds)}
    walls |= {f"z{k}": T().translate([0, 1, b]).scale([n / 2, 1, 0.02]) for k, b in enumerate(bounds)}
    centers = [(x, z) for x in bounds[:-1] + 0.5 for z in bounds[:-1] + 0.5]
    scene = mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40, "to_world": T().look_at([0, 3 * n, 0], [0, 0, 0], [0, 0, 1]),
                   "film": {"type": "hdrfilm", "width": 16, "height": 16}},
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(n / 2)},
        **{name: {"type": "cube", "to_world": place} for name, place in walls.items()},
        **{f"lamp{k}": {"type": "point", "position": [x, 0.5, z], "intensity": 1.0}
           for k, (x, z) in enumerate(centers)},
    })  # fmt: skip
    points = np.array([(x + 0.2, 0.1, z + 0.2) for x, z in centers])
    return scene, points[[int(e.id().removeprefix("lamp")) for e in scene.emitters()]]


def seen_and_hidden(loss: str, steps: int) -> tuple:
    """(predictions where a lamp is seen, where it is hidden, those at the start, mean visibility) among the cells."""
    scene, points = cells_scene()
    place = scene, scene.sensors()[0], LightTable(scene)
    groups = make_groups(place[-1], 64)
    points = points[place[-1].columns["emitter"]]
    cache = VisibilityCache(VisibilityTraining(loss=loss))
    cache.train(*place, groups, frames=1)
    first = said(cache, points)
    cache.train(*place, groups, frames=steps - 1)
    _, visible = cache._records(*place, groups, mi.UInt32([1]))
    found, same = said(cache, points), np.eye(len(points), dtype=bool)
    assert cache.statistics["visibility_recoveries"] == 0
    return found[same], found[~same], first, float(dr.mean(visible)[0])


def test_lamps_that_few_points_see_are_learned():
    """The gradient of a squared error vanishes where the sigmoid is near 0: all outputs fell to 0 within five steps."""
    seen, hidden, first, share = seen_and_hidden("cross_entropy", 48)
    print(f"seen by {share:.3f}; seen {seen.min():.2f} to {seen.max():.2f}, hidden {hidden.mean():.4f}")
    assert 0.01 < share < 0.04 and abs(first.mean() / share - 1) < 0.5
    assert seen.min() > 0.2 and seen.mean() > 0.9 and hidden.mean() < 0.01


def test_published_loss_and_start_are_those_of_a_key():
    seen, hidden, first, _ = seen_and_hidden("squared", 8)
    print(f"at the start {first.mean():.3f}; after 8 steps {seen.max():.1e}, {hidden.max():.1e}")
    assert 0.2 < first.mean() < 0.6 and max(seen.max(), hidden.max()) < 1e-3
    with pytest.raises(ValueError, match="loss is 'l2'; give one of: cross_entropy, squared"):
        VisibilityTraining(loss="l2")
    sampler = mi.load_dict({"type": "nvc_lights", "loss": "squared"})
    assert sampler.cache.training == VisibilityTraining(loss="squared")
    assert mi.load_dict({"type": "nvc_lights"}).cache.training.loss == "cross_entropy"
    with pytest.raises(RuntimeError, match="nvc_lights: loss is 'l2'"):
        mi.load_dict({"type": "nvc_lights", "loss": "l2"})


def gradients(loss: str, visible: np.ndarray) -> tuple:
    """(what a step reports, derivatives of the loss by the biases of the outputs, predictions) at some points."""
    n = visible.shape[1]
    field = VisibilityField([0] * 3, [1] * 3, FieldShape(n_levels=2, direction_degree=-1, n_outputs=len(visible)))
    x = mi.Point3f(*np.random.default_rng(0).random((3, n), np.float32))
    predicted, found = np.array([np.array(v) for v in field.query(x)]), {}

    def descend(optimizer, losses, averaged, *_):
        dr.backward(losses)
        last = [k for k in optimizer if k.endswith("bias")][-1]
        found["gradient"] = np.array(dr.grad(optimizer[last]))
        return averaged, dr.sum(dr.detach(losses))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(visibility, "descend", descend)
        value = field.step(x, mi.TensorXf(visible), mi.Float(0), mi.Float(0), loss)
    return float(value[0]), found["gradient"], predicted


def test_gradients_are_those_of_the_loss():
    """Both losses report the mean squared error, p being a sigmoid: d/dv of the cross-entropy is p - t."""
    visible = np.random.default_rng(1).integers(0, 2, (3, 64)).astype(np.float32)
    for loss in ("squared", "cross_entropy"):
        value, gradient, p = gradients(loss, visible)
        error = p - visible
        known = error if loss == "cross_entropy" else 2 * error * p * (1 - p)
        np.testing.assert_allclose(gradient, known.sum(axis=1) / visible.size, rtol=1e-3, atol=1e-5, err_msg=loss)
        assert value == pytest.approx((error**2).mean(), rel=1e-3)


def test_steps_taken_together_are_those_taken_one_by_one():
    """The points are found for eight steps in one go; the step after them is alone again."""
    scene = wall_scene()
    table = LightTable(scene)
    groups = make_groups(table, 32)
    seen = []
    for calls in ((8, 1), (1,) * 9):
        cache = VisibilityCache(VisibilityTraining(n_points=256), seed=3)
        points, step = [], cache.frame
        cache.recordable = False
        cache.frame = lambda field, x, v, *a, points=points, step=step: (
            points.append(np.vstack([np.array(x), np.array(v).reshape(groups.n_groups, -1)])), step(field, x, v, *a)
        )[1]  # fmt: skip
        for n in calls:
            cache.train(scene, scene.sensors()[0], table, groups, frames=n)
        seen.append((np.array(points), {k: np.array(v) for k, v in cache.field.averaged.parameters().items()}))
    (points, weights), (known, known_weights) = seen
    np.testing.assert_array_equal(points, known)
    assert len(points) == 9 and not np.array_equal(points[0], points[1])
    for k, v in known_weights.items():  # sums of gradients have no fixed order
        np.testing.assert_allclose(weights[k], v, atol=2e-3, err_msg=k)


def test_surface_points_lie_on_the_surface_on_the_side_that_is_seen():
    scene = wall_scene()
    rng = np.random.default_rng(0)
    o = rng.uniform([-2, 0.5, -2], [2, 4, 2], (4096, 3))
    d = rng.normal(size=(4096, 3))
    ray = mi.Ray3f(mi.Point3f(o.T), dr.normalize(mi.Vector3f(d.T)))
    si = scene.ray_intersect(ray)
    p, n, valid = surface_point(scene, ray, mi.Bool(True))
    found, known = np.array(valid), np.array(si.is_valid())
    np.testing.assert_array_equal(found, known)
    normal = np.array(dr.mulsign(mi.Vector3f(si.n), -dr.dot(si.n, ray.d))).T[known]
    cos = (np.array(n).T[known] * normal).sum(axis=1)
    distance = np.linalg.norm(np.array(p).T[known] - np.array(si.p).T[known], axis=1)
    print(f"normals right at {(cos > 0.99).mean():.3f} of the points, off by at most {distance.max():.1e}")
    assert (cos > 0.99).mean() > 0.97 and cos.min() > 0 - 1e-3 and distance.max() < 0.01


def test_number_of_recordings_is_constant_over_thirty_images():
    scene = wall_scene()
    integrator = mi.load_dict({
        "type": "nirc", "train_samples": 256, "train_frames": 2, "light_samples": 1,
        "light_sampler": {"type": "nvc_lights", "train_frames": 4, "train_samples": 256},
    })  # fmt: skip
    visibility = integrator.light_sampler.cache

    def recordings():
        return [*integrator.cache.recordings().values(), *visibility.recordings().values(),
                *(p.n_recordings for p in integrator.film_state.passes.recorded.values())]  # fmt: skip

    for k in range(5):
        integrator.render(scene, spp=1, seed=k)
    before, steps = recordings(), visibility.steps
    for k in range(30):
        integrator.render(scene, spp=1, seed=10 + k)
    print(f"recordings {before}")
    assert recordings() == before and max(before) <= 4 and visibility.steps == steps + 30


def test_training_follows_its_keys():
    scene = wall_scene()
    for keys, known in (({"train_frames": 3, "train_steps": 2}, [3, 5, 7]), ({"train_frames": 3, "train_steps": 0},
        [3, 3, 3]),
                        ({"train_frames": 3, "freeze": True}, [0, 0, 0]), ({"train_frames": 0, "train_steps": 1}, [0,
                            1, 2]),
                        ({"visibility": False}, [0, 0, 0])):  # fmt: skip
        integrator = path_with({"type": "nvc_lights", "train_samples": 64, **keys})
        found = []
        for k in range(3):
            integrator.render(scene, spp=1, seed=k)
            found.append(integrator.light_sampler.cache.steps)
        assert found == known, keys


def test_reset_forgets_what_was_learned():
    scene = wall_scene()
    integrator = path_with({"type": "nvc_lights", "train_samples": 64, "train_frames": 5})
    integrator.render(scene, spp=1)
    facts = integrator.light_sampler.statistics()
    assert facts["lights"] == facts["light_groups"] == 4 and facts["visibility_steps"] == 5
    integrator.light_sampler.reset()
    assert integrator.light_sampler.cache.steps == 0
    integrator.render(scene, spp=1)
    assert integrator.light_sampler.cache.steps == 5


def test_learned_visibility_lessens_the_noise_where_a_wall_stands_between_lights():
    scene = wall_scene()
    noise = {}
    for name in ("uniform", "unshadowed", "trained"):
        images = renders(scene, path_with(name), 16, 16)
        noise[name] = np.sqrt(images.var(axis=0)).mean()
    print({k: f"{v:.2e}" for k, v in noise.items()})
    assert noise["trained"] < 0.9 * noise["unshadowed"] and noise["trained"] < 0.9 * noise["uniform"]


def test_rate_and_decay_follow_their_schedule():
    t = VisibilityTraining()
    rates, decays = (np.array([f(k) for k in range(400)]) for f in (t.rate, t.decay))
    assert rates[0] == 0.05 and rates[200] == rates[-1] == pytest.approx(0.001) and (np.diff(rates) <= 0).all()
    assert decays[0] == 0 and decays[-1] == 0.9 and (np.diff(decays) >= 0).all()


def test_orthographic_camera_that_cannot_be_frozen_works():
    scene = mi.load_dict({
        "type": "scene", "a": {"type": "point", "position": [0, 0, 3]}, "b": {"type": "point", "position": [1, 0, 3]},
        "floor": {"type": "rectangle"},
        "sensor": {"type": "orthographic", "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 8, "height": 8}},
    })  # fmt: skip
    image = np.array(path_with({**SAMPLERS["trained"], "train_frames": 3}).render(scene, spp=4))
    assert np.isfinite(image).all() and image.mean() > 0
