"""Hard cases: scenes in which renderers and learned caches go wrong, and what is expected of them.

Most are one room of rectangles and a cube whose numbers are changed (kernels are shared), the others differ in one
part. :data:`CASES` is the list. A case is an image, whose mean unbiased integrators must hit, or a refusal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class Case:
    """One hard case.

    build     gives the scene
    known     gives the scene that the right image is that of, where `build`'s holds values that are not finite
    refusal   the error must contain this, whatever the integrator; None: an image is expected
    media     whether there are participating media: integrators that render these do not refuse it
    spp       samples a pixel of one of the images that are averaged
    sensors   how many of the scene's sensors are rendered
    """

    build: Callable[[], mi.Scene]
    known: Callable[[], mi.Scene] | None = None
    refusal: str | None = None
    spp: int = 32
    sensors: int = 1
    media: bool = False


@dataclass
class Room:
    """A room of 2 x 2 x 2 open to the camera, a cube on its floor, a lamp and a small second light under its ceiling.

    scale, shift      of everything, the camera too
    radiance          of the two lights
    albedo            of walls and cube; the back wall has four texels, `texels` if given, between half of it and it
    extra             further entries of the scene; None removes one
    camera, film      further keys of the sensor and its film
    """

    scale: float = 1.0
    shift: tuple = (0.0, 0.0, 0.0)
    radiance: tuple = (5.0, 20.0)
    albedo: float = 0.6
    texels: np.ndarray | None = None
    view: tuple = ((0.0, 0.0, 3.4), (0.0, 0.0, 0.0))
    block: object = None
    extra: dict = field(default_factory=dict)
    film: dict = field(default_factory=dict)

    def to_world(self, inner=None):
        outer = mi.ScalarTransform4f().translate(list(self.shift)).scale(self.scale)
        return outer if inner is None else outer @ inner

    def wall(self, *rotation, size=(1.0, 1.0), at=(0, 0, -1)):
        """A rectangle that faces the origin from `at` after a rotation (axis, degrees)."""
        turn = mi.ScalarTransform4f()
        if rotation:
            turn = turn.rotate(list(rotation[0]), rotation[1])
        return {"type": "rectangle", "to_world": self.to_world(turn.translate(list(at)).scale([*size, 1.0]))}

    def grey(self, values) -> dict:
        values = np.broadcast_to(np.asarray(values, np.float32), (2, 2))
        texels = np.ascontiguousarray(np.repeat(values[..., None], 3, axis=-1))
        texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "nearest"}
        return {"type": "diffuse", "reflectance": texture}

    def sensor(self, view=None, **film) -> dict:
        origin, target = view or self.view
        look = mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 1, 0])
        film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, **self.film, **film}
        # Scaled as the room is: the camera's own frame must stay of length 1
        placed = mi.ScalarTransform4f().translate(list(self.shift)) @ mi.ScalarTransform4f().translate(
            [self.scale * o for o in origin]
        ) @ mi.ScalarTransform4f().translate([-o for o in origin]) @ look
        return {
            "type": "perspective", "fov": 45, "to_world": placed, "near_clip": 1e-2 * self.scale,
            "far_clip": 1e4 * self.scale, "film": film,
        }  # fmt: skip

    def description(self) -> dict:
        a = self.albedo
        back = self.texels if self.texels is not None else [[a, 0.5 * a], [0.5 * a, a]]
        down = ([1, 0, 0], 90)
        block = self.block or {
            "type": "cube",
            "to_world": self.to_world(mi.ScalarTransform4f().translate([0.3, -0.7, 0.1]).rotate([0, 1, 0], 25).scale(
                [0.3, 0.3, 0.3])),
        }  # fmt: skip
        scene = {
            "type": "scene",
            "sensor": self.sensor(),
            "back": self.wall() | {"bsdf": self.grey(back)},
            "floor": self.wall([1, 0, 0], -90) | {"bsdf": self.grey(a)},
            "ceiling": self.wall(*down) | {"bsdf": self.grey(a)},
            "left": self.wall([0, 1, 0], 90) | {"bsdf": self.grey(a)},
            "right": self.wall([0, 1, 0], -90) | {"bsdf": self.grey(0.5 * a)},
            "block": block if "bsdf" in block else block | {"bsdf": self.grey(a)},
            "lamp": self.light(self.radiance[0], 0.25, (0.0, 0.0)),
            "spark": self.light(self.radiance[1], 0.05, (-0.7, 0.5)),
        }
        for name, value in self.extra.items():
            scene.pop(name, None)
            if value is not None:
                scene[name] = value
        return scene

    def light(self, radiance, size: float, at: tuple) -> dict:
        """A square light under the ceiling, at (x, z)."""
        place = self.wall([1, 0, 0], 90, size=(size, size), at=(at[0], at[1], -0.98))
        return place | {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": [radiance] * 3}},
                        "bsdf": self.grey(0.0)}  # fmt: skip

    def load(self) -> mi.Scene:
        return mi.load_dict(self.description())


def room(**changes) -> Callable[[], mi.Scene]:
    return lambda: Room(**changes).load()


def with_extra(make: Callable[[Room], dict], **changes) -> Callable[[], mi.Scene]:
    """A room with entries that are made by help of the room itself."""

    def build():
        r = Room(**changes)
        r.extra = {**r.extra, **make(r)}
        return r.load()

    return build


def mesh(positions, faces, albedo=0.6, radiance=None) -> mi.Mesh:
    """A triangle mesh of that albedo, or that shines."""
    positions, faces = np.asarray(positions, np.float32), np.asarray(faces, np.uint32)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(Room().grey(0.0 if radiance else albedo))
    if radiance:
        props["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": [radiance] * 3}})
    made = mi.Mesh("mesh", len(positions), len(faces), props=props)
    params = mi.traverse(made)
    params["vertex_positions"] = mi.Float(positions.ravel())
    params["faces"] = mi.UInt32(faces.ravel())
    params.update()
    return made


def quad(size=0.3, height=-0.5, thickness=0.0) -> tuple[list, list]:
    """A horizontal square seen from above, or two of them back to back."""
    s, h = size, height
    top = [[-s, h, -s], [-s, h, s], [s, h, s], [s, h, -s]]
    if not thickness:
        return top, [[0, 1, 2], [0, 2, 3]]
    bottom = [[x, y - thickness, z] for x, y, z in top]
    return top + bottom, [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]]


def degenerate() -> dict:
    """A mesh in which triangles of no area, of two equal corners and of a needle's shape lie among good ones."""
    positions, faces = quad()
    positions = [*positions, [0, -0.5, 0], [0.1, -0.5, 0], [0.2, -0.5, 0], [0.2, -0.5, 1e-30]]
    faces = [*faces, [4, 4, 4], [4, 5, 6], [5, 5, 6], [4, 6, 7]]
    return {"degenerate": mesh(positions, faces)}


def degenerate_light() -> dict:
    """The same as a light that faces down."""
    positions, faces = quad(0.3, 0.9)
    faces = [[a, c, b] for a, b, c in faces]
    positions = [*positions, [0, 0.9, 0], [0.1, 0.9, 0], [0.2, 0.9, 0]]
    return {"degenerate": mesh(positions, [*faces, [4, 4, 4], [4, 5, 6]], radiance=3.0)}


def many_lights(n: int) -> dict:
    """One mesh of `n` small triangles that shine downwards, spread under the ceiling; a tenth of them hardly."""
    rng = np.random.default_rng(0)
    corner = np.column_stack([rng.uniform(-0.9, 0.9, n), rng.uniform(0.8, 0.95, n), rng.uniform(-0.9, 0.9, n)])
    size = np.where(rng.random(n) < 0.1, 1e-4, 0.01)[:, None]
    offset = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]])
    positions = corner[:, None] + size[:, None] * offset[None]
    return {"stars": mesh(positions.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3), radiance=2.0)}


def bad_vertex(radiance=None) -> dict:
    """A square with a third triangle, of whose corners one is nowhere."""
    positions, faces = quad()
    positions = np.array([*positions, [0.0, np.nan, 0.0]], np.float32)
    return {"broken": mesh(positions, [*faces, [0, 1, 4]], radiance=radiance)}


def sun_sky(peak: float = 1e5) -> dict:
    """An environment map with one pixel so bright."""
    pixels = np.full((16, 32, 3), 0.2, np.float32)
    pixels[3, 20] = peak
    return {"sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels)}}


def sky_with(value: float) -> Callable[[], mi.Scene]:
    return lambda: Room(extra=sun_sky(value) | {"ceiling": None}).load()


def glass(r: Room) -> dict:
    """A ball of glass, a mirror opposite a mirror, a ball of gold."""
    ball = {"type": "sphere", "center": [-0.4, -0.6, 0.3], "radius": 0.35}
    return {
        "ball": ball | {"bsdf": {"type": "dielectric"}},
        "left": r.wall([0, 1, 0], 90) | {"bsdf": {"type": "conductor", "specular_reflectance": 0.95}},
        "right": r.wall([0, 1, 0], -90) | {"bsdf": {"type": "conductor", "specular_reflectance": 0.95}},
        "gold": {
            "type": "sphere", "center": [0.5, 0.2, -0.3], "radius": 0.25,
            "bsdf": {"type": "roughconductor", "material": "Au", "alpha": 0.02},
        },
    }  # fmt: skip


def all_delta(r: Room) -> dict:
    """Nothing but mirrors and glass."""
    mirror = {"type": "conductor", "specular_reflectance": 0.9}
    walls = {"back": (), "floor": ([1, 0, 0], -90), "ceiling": ([1, 0, 0], 90), "left": ([0, 1, 0], 90),
             "right": ([0, 1, 0], -90)}  # fmt: skip
    ball = {"type": "sphere", "center": [0.0, -0.5, 0.0], "radius": 0.4, "bsdf": {"type": "dielectric"}}
    return {name: r.wall(*turn) | {"bsdf": mirror} for name, turn in walls.items()} | {"block": ball}


def flipped_normals(r: Room) -> dict:
    """A floor whose normal map turns shading normals by more than a right angle in places."""
    rng = np.random.default_rng(0)
    n = rng.normal(size=(8, 8, 3))
    n[..., 2] = np.where(rng.random((8, 8)) < 0.3, -np.abs(n[..., 2]), np.abs(n[..., 2]) + 0.5)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap((0.5 + 0.5 * n).astype(np.float32)), "raw": True}
    bsdf = {"type": "normalmap", "normalmap": texture, "bsdf": {"type": "diffuse", "reflectance": 0.6}}
    return {"floor": r.wall([1, 0, 0], -90) | {"bsdf": bsdf}}


def alpha_mask(r: Room) -> dict:
    """A veil before everything, half of it holes, a quarter half open."""
    opacity = np.array([[0, 1], [0.5, 0]], np.float32)[..., None]
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(opacity), "raw": True, "filter_type": "nearest"}
    bsdf = {"type": "mask", "opacity": texture, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    return {"veil": r.wall(size=(0.8, 0.8), at=(0, 0, 0.7)) | {"bsdf": bsdf}}


def medium(_: Room) -> dict:
    fog = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 1.0}
    return {"block": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.3), "bsdf": {"type": "null"},
                      "interior": fog}}  # fmt: skip


def media(density: float, albedo: float) -> Callable[[Room], dict]:
    """Fog in a block, of an optical thickness of `density` over the room's side of 2."""

    def block(_: Room) -> dict:
        return {"block": medium(_)["block"] | {"interior": {"type": "homogeneous", "albedo": albedo,
                                                            "sigma_t": density / 2}}}  # fmt: skip

    return block


def sensors(r: Room, views: int = 3) -> dict:
    """Further sensors: from the side, from within the room, one that looks away."""
    looks = [((1.5, 0.5, 3.0), (0, 0, 0)), ((0, 0, 0.8), (0.3, -0.5, -1)), ((0, 0.3, 0.9), (0, 0.2, -1))]
    return {f"sensor{k}": r.sensor(look) for k, look in enumerate(looks[:views])}


FILTERS = ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos")


def filtered(name: str, border: bool = False) -> Callable[[], mi.Scene]:
    return room(film={"rfilter": {"type": name}, "sample_border": border})


def texel(value: float) -> np.ndarray:
    return np.array([[0.6, value], [0.3, 0.6]], np.float32)


#: The lit room, and the same with one light behind a slit that few paths find.
FIREFLY = {"radiance": (5.0, 1e6)}
DARK = (0.0, 0.0)

#: Every case by name.
CASES: dict[str, Case] = {
    "room": Case(room()),
    # ---- radiance
    "radiance 1e-6": Case(room(radiance=(5e-6, 2e-5))),
    "radiance 1e6": Case(room(radiance=(5e6, 2e7))),
    "radiance 1e-6 and 1e6": Case(room(radiance=(1e-6, 1e6))),
    "very dark": Case(room(radiance=(1e-12, 0.0))),
    "lights off": Case(room(radiance=DARK)),
    "firefly": Case(with_extra(lambda r: {"spark": r.light(1e6, 0.002, (0.6, -0.6))}), spp=64),
    # ---- extent and place
    "extent 1e-3": Case(room(scale=5e-4)),
    "extent 1e5": Case(room(scale=5e4)),
    "far from the origin": Case(room(shift=(1000.0, -500.0, 2000.0))),
    # ---- geometry
    "thin sheet": Case(lambda: Room(block=None, extra={"sheet": mesh(*quad(0.4, -0.3, 1e-4))}).load()),
    "coincident surfaces": Case(
        lambda: Room(extra={"one": mesh(*quad(0.4, -0.3)), "two": mesh(*quad(0.4, -0.3))}).load()
    ),
    "zero-area triangles": Case(lambda: Room(extra=degenerate()).load()),
    "zero-area lights": Case(lambda: Room(extra=degenerate_light()).load()),
    "grazing view": Case(room(view=((0.0, -0.98, 3.4), (0.0, -1.0, 0.0)))),
    # ---- albedo
    "albedo 0": Case(room(albedo=0.0)),
    "albedo 1": Case(room(albedo=1.0), spp=32),
    # ---- lights
    "no light": Case(room(extra={"lamp": None, "spark": None}), refusal="no emitter"),
    "one light": Case(room(extra={"spark": None})),
    "10,000 lights": Case(lambda: Room(extra=many_lights(10_000)).load()),
    "light behind the camera": Case(
        with_extra(lambda r: {"lamp": r.wall([0, 1, 0], 180, size=(0.5, 0.5), at=(0, 0, -4)) | {
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [30.0] * 3}}, "bsdf": r.grey(0.0)}})
    ),
    "sun pixel 1e5": Case(lambda: Room(extra=sun_sky() | {"ceiling": None}).load(), spp=32),
    # ---- materials
    "specular chains": Case(with_extra(glass), spp=64),
    "all delta": Case(with_extra(all_delta), spp=64),
    "flipped normals": Case(with_extra(flipped_normals)),
    "alpha mask": Case(with_extra(alpha_mask)),
    "participating medium": Case(with_extra(medium), refusal="participating medium", media=True),
    "thin medium": Case(with_extra(media(1e-4, 0.8)), refusal="participating medium", media=True),
    "thick medium": Case(with_extra(media(1e4, 0.8)), refusal="participating medium", media=True),
    "medium of albedo 1": Case(with_extra(media(4.0, 1.0)), refusal="participating medium", media=True),
    # ---- NaN and infinity
    "NaN in a texture": Case(room(texels=texel(np.nan)), known=room(texels=texel(0.0))),
    "infinity in a texture": Case(room(texels=texel(np.inf)), known=room(texels=texel(0.0))),
    "NaN in a mesh": Case(
        lambda: Room(extra=bad_vertex()).load(), known=lambda: Room(extra={"good": mesh(*quad())}).load()
    ),
    "NaN in a light's mesh": Case(lambda: Room(extra=bad_vertex(3.0)).load(), refusal="not finite"),
    "NaN in an emitter": Case(room(radiance=(float("nan"), 20.0)), refusal="not finite"),
    "infinity in an emitter": Case(room(radiance=(float("inf"), 20.0)), refusal="not finite"),
    "NaN in the sky": Case(sky_with(np.nan), refusal="not finite"),
    # ---- films and sensors
    "one pixel": Case(room(film={"width": 1, "height": 1}), spp=1024),
    "8192x16": Case(room(film={"width": 8192, "height": 16}), spp=1),
    "crop window": Case(room(film={"crop_offset_x": 5, "crop_offset_y": 9, "crop_width": 7, "crop_height": 3}), spp=64),
    "several sensors": Case(with_extra(sensors), sensors=3),
    **{f"{name} filter": Case(filtered(name)) for name in FILTERS[1:]},
    "sample_border": Case(filtered("gaussian", border=True)),
}
