"""Lights that Mitsuba's own next-event estimation gets wrong: they are found, and what we make of them is right.

The reference is the light that rays find: ``direct`` with ``emitter_samples=0``.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import sweep
from expectation import assert_mean, assert_same_mean, renders
from light_scenes import at, glow, picture, place, uniforms

from mi_neural.integrators import planning
from mi_neural.light_noise import LightNoise
from mi_neural.lights.inexact import inexact
from mi_neural.lights.table import LightTable
from mi_neural.plan import Request, SceneFacts, of_integrator, of_sampler
from mi_neural.render import vertex

BLACK = {"type": "diffuse", "reflectance": 0.0}
PLACE = at(0.3, 0.2, 2).rotate([0.6, 0.8, 0], 40)
#: No rotation, as the axis is not of length 1.
ODD = at(0.3, 0.2, 2).rotate([1, 1, 0], 40).scale(0.3)


def shine():
    """A picture of bright and dark spots."""
    return glow(picture(np.random.default_rng(2).uniform(0, 1, (4, 8, 3)).astype(np.float32) ** 2 * 9))


def quad(bent=0.0, attribute=None, textured=False):
    """A square as a mesh: its shading normals off by an angle, or its radiance a mesh attribute or a picture."""
    props = mi.Properties()
    emission = glow({"type": "mesh_attribute", "name": attribute}) if attribute else shine() if textured else glow(5.0)
    props["emitter"], props["bsdf"] = mi.load_dict(emission), mi.load_dict(BLACK)
    mesh = mi.Mesh("quad", 4, 2, has_vertex_normals=True, has_vertex_texcoords=textured, props=props)
    if attribute:
        values = np.random.default_rng(3).uniform(0, 9, 12 if attribute.startswith("vertex") else 6)
        mesh.add_attribute(attribute, 3, values.astype(np.float32).tolist())
    params = mi.traverse(mesh)
    corners = np.array([[-0.5, -0.5, 2], [-0.5, 0.5, 2], [0.5, 0.5, 2], [0.5, -0.5, 2]], np.float32)
    normal = np.array([np.sin(bent), 0, -np.cos(bent)], np.float32)
    params["vertex_positions"], params["vertex_normals"] = mi.Float(corners.ravel()), mi.Float(np.tile(normal, 4))
    if textured:
        params["vertex_texcoords"] = mi.Float(np.array([0, 0, 1, 0, 1, 0.7, 0.2, 1], np.float32))
    params["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    params.update()
    return mesh


def stretched(*scale):
    return PLACE.scale(list(scale))


SHEAR = mi.ScalarTransform4f(np.array([[1, 0.8, 0, 0], [0, 1, 0, 0], [0.3, 0, 1, 0], [0, 0, 0, 1.0]]))
#: Lamps, and what is said of them.
WRONG = {
    "picture on a cube": ({"type": "cube", "to_world": stretched(0.3, 0.2, 0.3), "emitter": "shine"},
                          "a picture on a mesh"),
    "picture on a quad": (lambda: quad(textured=True), "a picture on a mesh"),
    "vertex attribute": (lambda: quad(attribute="vertex_color"), "a mesh attribute"),
    "face attribute": (lambda: quad(attribute="face_color"), "a mesh attribute"),
    "bent normals": (lambda: quad(0.9), "a mesh with bent normals"),
    "picture on a cylinder": ({"type": "cylinder", "to_world": stretched(0.3, 0.3, 0.8), "emitter": "shine"},
                              "a picture on a cylinder"),
    "picture in a cylinder": ({"type": "cylinder", "to_world": stretched(0.5, 0.5, 0.2), "flip_normals": True,
                               "emitter": "shine"}, "a picture on a cylinder"),
    **{f"odd {kind}": ({"type": kind, "to_world": ODD}, "a rotation about an axis that is not of length 1")
       for kind in ("rectangle", "disk", "cylinder")},
    "odd cube": ({"type": "cube", "to_world": ODD}, "a mesh with bent normals"),
    "elliptic cylinder": ({"type": "cylinder", "to_world": stretched(0.5, 0.2, 0.3)}, "a stretched cylinder"),
    "sheared cylinder": ({"type": "cylinder", "to_world": stretched(0.3, 0.3, 0.3) @ SHEAR}, "a stretched cylinder"),
    "mirrored cylinder": ({"type": "cylinder", "to_world": stretched(-0.3, 0.3, 0.8)}, "a mirrored cylinder"),
    "mirrored and flipped": ({"type": "cylinder", "to_world": stretched(-0.5, 0.5, 0.2), "flip_normals": True},
                             "a mirrored cylinder"),
}  # fmt: skip
RIGHT = {
    "quad": lambda: quad(),
    "cube": {"type": "cube", "to_world": stretched(0.3, 0.2, 0.3)},
    "rectangle": {"type": "rectangle", "to_world": stretched(0.3, -0.2, 0.3) @ SHEAR},
    "picture on a rectangle": {"type": "rectangle", "to_world": stretched(0.3, 0.2, 0.3), "flip_normals": True,
                               "emitter": "shine"},
    "disk": {"type": "disk", "to_world": stretched(0.3, 0.5, 0.3), "flip_normals": True},
    "mirrored disk": {"type": "disk", "to_world": stretched(-0.3, 0.5, -0.3) @ SHEAR},
    "picture on a disk": {"type": "disk", "to_world": stretched(0.3, 0.5, -0.3), "emitter": "shine"},
    "sphere": {"type": "sphere", "center": [0.3, 0.2, 1.5], "radius": 0.7},
    "distant sphere": {"type": "sphere", "center": [3, 2, 40], "radius": 0.01},
    "picture on a sphere": {"type": "sphere", "center": [0.3, 0.2, 1.5], "radius": 0.7, "emitter": "shine"},
    "inside of a sphere": {"type": "sphere", "radius": 3.0, "flip_normals": True},
    "cylinder": {"type": "cylinder", "p0": [-0.4, 0.2, 1], "p1": [0.4, 0.3, 2], "radius": 0.3},
    "inside of a cylinder": {"type": "cylinder", "to_world": stretched(0.5, 0.5, 0.2), "flip_normals": True},
}  # fmt: skip


#: Of the default run: one of each kind.
DEFAULT = ("picture on a cube", "vertex attribute", "bent normals", "picture on a cylinder", "odd rectangle",
           "sheared cylinder", "mirrored and flipped", "picture on a rectangle", "mirrored disk", "distant sphere",
           "cylinder")  # fmt: skip


def lamp_of(lamp):
    if callable(lamp):
        return lamp()
    emission = shine() if lamp.get("emitter") == "shine" else glow(5.0)
    return {**lamp, "emitter": emission, "bsdf": BLACK}


def scene_with(lamp, **more) -> mi.Scene:
    return mi.load_dict({"type": "scene", "lamp": lamp_of(lamp), **more})


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", [*WRONG, *RIGHT])
def test_lights_that_mitsuba_samples_wrong_are_found(name):
    lamp, why = WRONG[name] if name in WRONG else (RIGHT[name], "")
    scene = scene_with(lamp)  # an emitter does not keep its shape alive
    assert [inexact(e) for e in scene.emitters()] == [why]


# ---------------------------------------------------------------- the table is right


def fluence(scene, table, p, n: int, seed: int = 0) -> tuple:
    """``∫ Le dω`` at `p`, samples of it: by rays, by the table, and by both, weighted by their densities."""
    c = table.columns
    center = (c["center"] * 1.0).mean(axis=0)
    reach = np.linalg.norm(c["center"] - center, axis=1).max() + c["radius"].max()
    to = mi.Vector3f(*(center - np.asarray(p)).tolist())
    distance = float(dr.norm(to)[0])
    # A cone around the lamp, by 1 - cos: the cosine of a narrow one is 1 in single precision
    sin_max = 1.01 * reach / distance if distance > 1.01 * reach else np.inf
    opening = float(sin_max**2 / (1 + np.sqrt(1 - sin_max**2))) if sin_max < 1 else 2.0
    numbers, si = uniforms(n, seed), place(p, n)
    frame = mi.Frame3f(dr.normalize(to) if distance > 0 else mi.Vector3f(0, 0, 1))
    u = numbers.next_2d()
    below, (sin_phi, cos_phi) = opening * u.x, dr.sincos(dr.two_pi * u.y)
    sin = dr.sqrt(below * (2 - below))
    d = frame.to_world(mi.Vector3f(cos_phi * sin, sin_phi * sin, 1 - below))
    pdf_ray = 1 / (2 * np.pi * opening)
    met = scene.ray_intersect(mi.Ray3f(si.p, d))
    index, emits = table.index_of(scene, met)
    Le = dr.select(emits, met.emitter(scene).eval(met), 0)
    ds = mi.DirectionSample3f(scene, met, vertex.reference_point(si.p, si.n))
    pdf = dr.select(emits, table.pdf(scene, si, index, met, ds, emits), 0) / table.n_lights
    np.testing.assert_allclose(np.array(table.emitted(scene, met, index, emits)), np.array(Le), rtol=1e-5)

    light = mi.UInt32(numbers.next_1d() * table.n_lights)
    ds, weight, pdf_light = table.sample(scene, si, light, numbers.next_2d(), mi.Bool(True))
    seen = (pdf_light > 0) & ~scene.ray_test(si.spawn_ray_to(ds.p))
    pdf_light /= table.n_lights
    away = dr.norm(dr.cross(ds.d, frame.n))
    in_cone = mi.Bool(sin_max == np.inf) | (dr.dot(ds.d, frame.n) > 0) & (away <= float(sin_max))
    grey = lambda v: np.array(dr.mean(v) + dr.zeros(mi.Float, n), np.float64)  # noqa: E731
    rays = grey(Le / pdf_ray)
    lights = grey(dr.select(seen, weight * table.n_lights, 0))
    both = grey(Le / (pdf_ray + pdf))
    both += grey(dr.select(seen, weight * table.n_lights * pdf_light / (pdf_light + dr.select(in_cone, pdf_ray, 0)), 0))
    return rays, lights, both


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", sweep([*WRONG, *RIGHT], DEFAULT))
def test_samples_of_the_table_give_the_light_that_rays_find(name):
    lamp = WRONG[name][0] if name in WRONG else RIGHT[name]
    scene = scene_with(lamp)
    table = LightTable(scene)
    for p in ([0, 0, 0], [0.35, 0.25, 1.9]):
        rays, lights, both = fluence(scene, table, p, 2**17)
        known = rays.mean()
        spread = rays.std() / np.sqrt(rays.size)
        for samples, what in ((lights, "samples"), (both, "both")):
            # The reference has an error of its own
            assert_mean(samples, known, f"{name}, {what}", relative=4 * spread / known + 2e-4 if known > 0 else 0)


# ---------------------------------------------------------------- plans


def facts(lights=1, **wrong) -> SceneFacts:
    return SceneFacts({"area": lights}, 0, lights, {"lambertian": 4}, 0, None, (64, 64), 2.0, 1, False, 0, wrong)


def test_plans_have_a_light_sampler_where_mitsuba_is_not_exact():
    def chosen(n, look=None):
        made = of_integrator(facts(n, **{"a mesh attribute": 1}), Request("nirc", look=look))
        return made.decisions["light_sampler"]

    assert chosen(1).value == "uniform_lights"
    assert "a mesh attribute" in chosen(1).because
    assert chosen(9).value == "power_lights"
    assert chosen(9, lambda: LightNoise(1.0, 2.0, 2.0)).value == "uniform_lights"
    assert chosen(9, lambda: LightNoise(2.0, 1.9, 2.0)).value == "power_lights"
    assert chosen(9, lambda: LightNoise(2.0, 2.0, 0.01)).value == "nvc_lights"
    assert not chosen(2**20).modelled and "is not exact" in chosen(2**20).because
    for name in ("uniform_lights", "power_lights", "tree_lights", "nvc_lights"):
        assert of_sampler(facts(1, **{"a mesh attribute": 1}), Request(name)).modelled("light_sampler")
        assert not of_sampler(facts(1), Request(name)).modelled("light_sampler")


FILM = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
VIEW = mi.ScalarTransform4f().look_at([0, -3, 1.5], [0, 0, 0], [0, 0, 1])
CAMERA = {"type": "perspective", "fov": 20, "to_world": VIEW, "film": FILM}


@pytest.fixture(scope="module")
def lit_by_bent_normals():
    """A floor under a lamp of bent normals, and images of it by BSDF samples alone: `path` is off by a fifth."""
    scene = scene_with(lambda: quad(0.9), floor={"type": "rectangle"}, camera=CAMERA)
    reference = renders(scene, {"type": "direct", "emitter_samples": 0, "bsdf_samples": 16}, 8, 64)
    path = renders(scene, {"type": "path", "max_depth": 2}, 8, 64)
    with pytest.raises(AssertionError):
        assert_same_mean(path, reference, "path", blocks=2)
    return scene, reference


@pytest.mark.parametrize("type_", ["nirc", "nrc", "nirc_two_level"])
def test_one_light_is_exact_in_integrators_that_plan(lit_by_bent_normals, type_):
    scene, reference = lit_by_bent_normals
    ours = mi.load_dict({"type": type_, "max_depth": 2})
    assert ours.make_plan(scene)["light_sampler"] == "uniform_lights"
    assert_same_mean(renders(scene, ours, 8, 64), reference, type_, blocks=2)


@pytest.mark.parametrize("sampler", ["uniform_lights", "power_lights", "tree_lights", "nvc_lights"])
def test_one_light_is_exact_with_a_light_sampler(lit_by_bent_normals, sampler):
    scene, reference = lit_by_bent_normals
    nested = {"type": sampler, **({"train_frames": 1, "train_samples": 64} if sampler == "nvc_lights" else {})}
    ours = renders(scene, {"type": "plain_path", "max_depth": 2, "light_sampler": nested}, 8, 64)
    assert_same_mean(ours, reference, sampler, blocks=2)


def test_integrators_without_a_plan_get_a_light_sampler_where_they_need_one(lit_by_bent_normals):
    scene, reference = lit_by_bent_normals
    sampler = planning.exact_sampler(scene)
    assert sampler.plugin == "uniform_lights"
    ours = mi.load_dict({"type": "plain_path", "max_depth": 2, "light_sampler": sampler})
    assert_same_mean(renders(scene, ours, 8, 64), reference, "plain_path", blocks=2)
    assert planning.exact_sampler(scene_with(RIGHT["cube"])) is None
    assert planning.exact_sampler(scene_with(WRONG["picture on a cube"][0])).plugin == "power_lights"
