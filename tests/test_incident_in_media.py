"""The incident cache of `nirc` in participating media: its records, and the images that show it, against `volpath`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, sweep
from expectation import assert_mean, assert_same_mean, renders
from media_scenes import ball, cube, fog, lamp, rgb, room, smoke
from test_caches_in_media import DEPTH, HALF_OPEN, SCENES, TRACED, cloud, two_clouds
from test_caches_in_media import known as known  # a fixture

from mi_neural.caches.field import Field
from mi_neural.caches.incident import WORLD_SHARE, IncidentCache, Training, trace_records
from mi_neural.caches.voxels import Ages
from mi_neural.caches.weights import FieldShape
from mi_neural.render.media import Media
from mi_neural.render.sampling import PathSampler
from mi_neural.render.walk import MediaWalk


def incident_records(scene, n=4096, field=None, camera=0, places=None, **constants):
    """Records of incident light, of which the first `n` are those at the first vertices."""
    sensor = scene.sensors()[camera]
    walk = MediaWalk(Media.of(scene, scene.sensors()), sensor.get_medium(), windows=True)
    training = Training(n_paths=n, **constants)
    records, _ = trace_records(scene, sensor, field, training, mi.UInt32(3), None, places, walk)
    dr.eval(records)
    return records


def unscattered(records, half=0.5, density=4.0) -> np.ndarray:
    """Share of the light that reaches records in a cloud, a cube about the origin, from outside in a straight line."""
    p, d = np.array(records.position).T, np.array(records.direction).T
    with np.errstate(divide="ignore", invalid="ignore"):
        way = np.where(d > 0, (half - p) / d, (-half - p) / d).min(axis=1)
    return np.exp(-density * np.maximum(way, 0))


def test_incident_records_hold_what_arrives_through_the_medium():
    """Under a sky of 1, with an albedo of 1, all light that arrives is 1. What comes from the sky in a straight line is
    direct light, and is not in the records. One choice of seeds in ten thousand fails by chance."""
    records = incident_records(cloud())
    first = np.flatnonzero(np.array(records.valid)[:4096])
    assert len(first) > 1000 and (np.array(records.inside)[first] % 2 == 0).all(), "at points in the medium"
    target = np.array(records.target).mean(axis=0)[first]
    assert_mean(target + unscattered(records)[first], 1.0, "incident")
    assert target.std() > 0.1


def test_weights_of_incident_records_leave_the_way_out():
    """The weighted loss multiplies errors by f cos/p: at a point in a medium that is 1, whatever the medium on the way
    left of the light, and p is the density of the phase function."""
    records = incident_records(cloud(), 512, loss="weighted")
    valid = np.array(records.valid)
    np.testing.assert_allclose(np.array(records.weight)[:, valid], 1, rtol=1e-4)
    pdf, g = 4 * np.pi * np.array(records.pdf)[valid], 0.3
    assert pdf.min() > 0.999 * (1 - g) / (1 + g) ** 2 and pdf.max() < 1.001 * (1 + g) / (1 - g) ** 2


def test_incident_records_lie_at_rough_glass_and_at_masks():
    """Nothing is seen through a point there whose light a cache of incident light would have to know."""
    glass = ball(fog(8.0, 0.9), {"type": "roughdielectric", "alpha": 0.2}, radius=0.4, at=(-0.3, -0.3, 0))
    records = incident_records(room(ball=glass, box=cube(fog(2.0), HALF_OPEN, size=0.3, at=(0.6, -0.6, 0))))
    position = np.array(records.position).T[np.array(records.valid)]
    on_glass = np.abs(np.linalg.norm(position - [-0.3, -0.3, 0], axis=1) - 0.4) < 1e-4
    on_box = np.abs(np.abs(position - [0.6, -0.6, 0]).max(axis=1) - 0.3) < 1e-4
    assert on_glass.sum() > 500 and on_box.sum() > 100


def test_what_a_ray_has_found_is_the_same_after_the_path_went_on():
    """Where a ray left the scene, `traced` became false with :meth:`Media.advance`, and `nirc` was 9 % too bright."""
    scene = cloud(0.5)
    walk = MediaWalk(Media.of(scene))
    lane = dr.arange(mi.UInt32, 64)
    sampler = PathSampler.make(lane, mi.UInt32(1))
    ray = mi.Ray3f(mi.Point3f(0, 0, 2) + dr.zeros(mi.Point3f, 64), mi.Vector3f(0, 0, -1))
    path, sampler = walk.camera_vertex(mi.load_dict(TRACED["nrc"]), scene, ray, sampler, mi.Bool(True))
    found, _ = walk.bounce(mi.load_dict(TRACED["nrc"]), scene, None, path, sampler)
    before = np.array(found.traced).copy()
    walk.advance(mi.load_dict(TRACED["nrc"]), path, found)
    np.testing.assert_array_equal(np.array(found.traced), before)
    assert before.any() and not np.array(found.end.scattered | found.end.si.is_valid())[before].all()


TERMINATIONS = [{"termination": t} for t in ("primary", "spread", "balanced", "balanced_shares", "adaptive")]
TERMINATIONS.append({"denoised": True})
LEARNED = {"train_frames": 64, "train_samples": 1024, "train_steps": 0, **NETWORK, **DEPTH}


@pytest.mark.parametrize("name, keys", sweep(
    [(name, keys) for name in SCENES for keys in TERMINATIONS],
    [("half open shell", TERMINATIONS[2]), ("colours", TERMINATIONS[4]), ("in rough glass", TERMINATIONS[5])],
))  # fmt: skip
def test_nirc_shows_the_light_of_volpath(name, keys, known):
    """Of paths of all depths: those in the cache have no limit."""
    make, reference = SCENES[name]
    scene = make()
    images = known(f"{name}, all", scene, {"type": reference, "max_depth": -1})
    found = renders(scene, {"type": "nirc", **LEARNED, "max_depth": -1, **keys}, 4, 64)
    error, noise = found.mean() / images.mean() - 1, images.mean((1, 2, 3)).std(ddof=1) / 4 / images.mean()
    print(f"{name}, {keys}: {error:+.2%}, noise of the reference {noise:.2%}")
    assert np.isfinite(found).all()
    assert abs(error) < 0.05


@pytest.mark.parametrize("albedo", sweep([1.0, 0.8], [0.8]))
def test_cloud_seen_by_incident_light_in_the_cache(albedo):
    """Its first vertices ask the cache: the image is 1 where the albedo is 1, else that of `volpath`."""
    scene = cloud(albedo)
    keys = {"termination": "primary", "channels": "direct, cache"}
    images = renders(scene, {"type": "nirc", **LEARNED, **keys, "train_frames": 96, "max_depth": -1}, 2, 64,
                     channels=slice(None))  # fmt: skip
    middle = np.s_[:, 3:5, 3:5]
    expected = 1.0 if albedo == 1 else renders(scene, {"type": "volpath", "max_depth": -1}, 4, 256)[middle].mean()
    assert abs(images[middle][..., :3].mean() / expected - 1) < 0.05
    assert images[middle][..., -3:].mean() > 0.2 * expected, "the cache was seen"


@pytest.mark.parametrize("hide, keys", sweep(
    [(hide, keys) for hide in (False, True) for keys in ({}, {"denoised": True})], [(True, {})]
))  # fmt: skip
def test_coverage_with_a_cache_is_that_of_volpath(hide, keys):
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    scene = room({"film": film}, back=ball(fog(3.0), at=(0.6, 0.2, 0)), box=cube(fog(2.0), HALF_OPEN, 0.3),
                 seen=lamp((0, 0.2, -0.8), rgb(1.0, 2.0, 3.0), 0.2))  # fmt: skip
    limits = {"max_depth": 4, "hide_emitters": hide}

    def alpha(integrator, first):
        images = renders(scene, integrator, 16, 64, first, channels=slice(3, 4))
        return np.repeat(images, 3, axis=-1)

    ours = alpha({"type": "nirc", **LEARNED, "train_frames": 2, "train_samples": 256, **limits, **keys}, 0)
    assert_same_mean(ours, alpha({"type": "volpath", **limits}, 500), "alpha", blocks=2, relative=1e-4, tests=4)


def test_incident_cache_of_a_file_goes_on_in_media(tmp_path):
    """It shows the same image, and starts paths where records lay once it knows what these places are in."""
    scene = room(box=cube(smoke()))
    keys = {"type": "nirc", **LEARNED, "train_frames": 4, "train_samples": 256, "freeze_cache": False}
    first, second = mi.load_dict(keys), mi.load_dict(keys)
    image = np.array(mi.render(scene, integrator=first, spp=4, seed=1))
    assert (np.array(first.cache.ages.places.inside) > 0).mean() > 0.5
    first.save_cache(tmp_path / "a.npz")
    second.load_cache(tmp_path / "a.npz", scene)
    again = np.array(mi.render(scene, integrator=second, spp=4, seed=1))
    np.testing.assert_allclose(again, image, rtol=1e-3, atol=1e-4)
    assert (np.array(second.cache.ages.places.inside) == 0).all()
    second.train(scene, 1)
    assert (np.array(second.cache.ages.places.inside) > 0).mean() > 0.2


def test_incident_records_lie_where_records_lay_that_are_out_of_view():
    """Of paths that start in the white cloud and on the white ball in it, while the camera sees nothing but black
    smoke: all light that arrives there is 1."""
    scene = two_clouds()
    field = Field([-1] * 3, [1] * 3, FieldShape(n_levels=1, hashmap_size=64, width=4, n_hidden=1))
    records = incident_records(scene)
    ages, cache = Ages([-1] * 3, [1] * 3), IncidentCache()
    for k in range(16):
        cache.remember(ages, records, PathSampler.make(dr.arange(mi.UInt32, 4096), mi.UInt32(k)))
    ages.usual = mi.Float(1)  # no place has records of late
    back = incident_records(scene, field=field, camera=1, places=ages.left(mi.Float(1e-3)))
    position, valid = np.array(back.position).T[:4096], np.array(back.valid)[:4096]
    there = valid & (np.abs(position).max(axis=1) < 0.5)
    assert abs(there.mean() - WORLD_SHARE) < 0.1
    inside = there & (np.array(back.inside)[:4096] % 2 == 0)
    target = np.array(back.target).mean(axis=0)[:4096]
    way = unscattered(back)[:4096] * ~hits_ball(position, np.array(back.direction).T[:4096])
    assert_mean((target + way)[inside], 1.0, "in the cloud")


def hits_ball(p, d, radius=0.2) -> np.ndarray:
    """Whether rays meet the ball of :func:`two_clouds`."""
    b = (p * d).sum(axis=1)
    return (b < 0) & (b**2 - (p**2).sum(axis=1) + radius**2 > 0)
