"""One parameter of a scene as a function of the frame: finding it, computing its values, setting them.

Parameters are those of ``mi.traverse(scene)``, and two more:

``SHAPE.to_world``   of a mesh: a 4x4 matrix applied to the mesh as it was when the scene was loaded. Its original value
                     is the identity, so that ``translate(0, 1, 0) @ value`` lifts a mesh as it does a sphere
``LIGHT.direction``  of a directional or spot light: the unit vector in which its light travels

Values are NumPy arrays: numbers have shape (), colours, points and directions (3,), transforms (4, 4) or (3, 3),
textures (height, width, channels), vertex positions (3 n,) as Mitsuba lists them.
"""

from __future__ import annotations

import ast
import difflib
import hashlib
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .. import parameters
from .load import InputError, one_line, user_path

#: New value of a parameter: function(frame, original value) -> value of the same shape.
Function = Callable[[int, np.ndarray], np.ndarray]

# ------------------------------------------------------------------------------------------------------------------
# Parameters


class Parameter:
    """One parameter of a scene: `key`, `value` as it was when this object was made (float64), :meth:`set`."""

    def __init__(self, params, key: str) -> None:
        self.params, self.key = params, key
        self.value = _numbers(key, params[key])

    def check(self, value: object) -> np.ndarray:
        """`value` as an array fit for :meth:`set`; ``ValueError`` says what is wrong with it."""
        try:
            value = np.asarray(value, np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"gives a {type(value).__name__}, not numbers of shape {self.value.shape}") from None
        if value.shape != self.value.shape:
            raise ValueError(f"gives shape {value.shape}, the parameter has shape {self.value.shape}")
        if not np.isfinite(value).all():
            raise ValueError("gives NaN or infinite values")
        if self.value.shape == (4, 4):
            _check_transform(value)
        return value

    def set(self, value: np.ndarray) -> None:
        """Set a checked value; ``params.update()`` is up to the caller."""
        _assign(self.params, self.key, value)


class MeshPlacement(Parameter):
    """``SHAPE.to_world`` of a mesh. Texture coordinates stay, normals follow."""

    def __init__(self, params, shape: str) -> None:
        self.params, self.key, self.shape = params, f"{shape}.to_world", shape
        self.value = np.eye(4)
        self.positions, self.normals = (
            np.array(params[f"{shape}.{name}"], np.float64).reshape(-1, 3)
            for name in ("vertex_positions", "vertex_normals")
        )

    def set(self, value: np.ndarray) -> None:
        moved = not np.array_equal(value, np.eye(4))  # the identity returns exactly the same numbers
        positions = self.positions @ value[:3, :3].T + value[:3, 3] if moved else self.positions
        _assign(self.params, f"{self.shape}.vertex_positions", positions.ravel())
        if self.normals.size:
            normals = self.normals @ np.linalg.inv(value[:3, :3]) if moved else self.normals
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            normals = normals / np.where(length > 0.0, length, 1.0) if moved else normals
            _assign(self.params, f"{self.shape}.vertex_normals", normals.ravel())


class LightDirection(Parameter):
    """``LIGHT.direction`` of a light that shines along the z axis of its transform."""

    def __init__(self, params, light: str) -> None:
        self.params, self.key = params, f"{light}.direction"
        self.transform = f"{light}.to_world"
        self.original = _numbers(self.transform, params[self.transform])
        self.value = self.original[:3, 2] / np.linalg.norm(self.original[:3, 2])

    def check(self, value: object) -> np.ndarray:
        value = super().check(value)
        if np.linalg.norm(value) == 0.0:
            raise ValueError("gives the direction [0, 0, 0]")
        return value / np.linalg.norm(value)

    def set(self, value: np.ndarray) -> None:
        if np.array_equal(value, self.value):
            _assign(self.params, self.transform, self.original)
            return
        # The shortest turn from the old direction to the new, so that what a spot projects does not spin
        axis, cos = np.cross(self.value, value), float(self.value @ value)
        if np.linalg.norm(axis) < 1e-9:
            axis = np.cross(self.value, np.eye(3)[np.abs(self.value).argmin()])
        turn = rotate(axis, np.degrees(np.arctan2(np.linalg.norm(np.cross(self.value, value)), cos)))
        turned = self.original.copy()
        turned[:3, :3] = turn[:3, :3] @ self.original[:3, :3]
        _assign(self.params, self.transform, turned)


def keys(params) -> dict[str, Callable[[], Parameter]]:
    """All that can be changed, by key: those of ``mi.traverse`` without the film, and the two kinds of our own."""
    found: dict[str, Callable[[], Parameter]] = {}
    for key, (_, _, node, _) in params.properties.items():
        if ".film." in key or parameters.read(params, key) is None:
            continue
        found[key] = lambda key=key: Parameter(params, key)
        owner, _, name = key.rpartition(".")
        if name == "vertex_positions" and f"{owner}.to_world" not in params:
            found[f"{owner}.to_world"] = lambda owner=owner: MeshPlacement(params, owner)
        if name == "to_world" and f"{owner}.direction" not in params and _shines(node):
            found[f"{owner}.direction"] = lambda owner=owner: LightDirection(params, owner)
    return found


def of_sensors(scene, names) -> bool:
    """Whether the parameters of these names all belong to sensors, so that joined meshes and materials do not
    matter."""
    import mitsuba as mi

    params = mi.traverse(scene)
    known = keys(params)
    nodes = [params.properties.get(find_key(known, name), (None, None, None, 0))[2] for name in names]
    return all(isinstance(node, mi.Sensor) for node in nodes)


def find_key(known, key: str) -> str:
    """The key that `key` stands for: itself, or the only one that ends in it, `.value` and `.data` left out or not.

    Raises :class:`InputError` for a key that is unknown or stands for several.
    """
    if key in known:
        return key
    ends = [key, f"{key}.value", f"{key}.data"]
    matches = [k for k in known if any(k == end or k.endswith("." + end) for end in ends)]
    if len(matches) == 1:
        return matches[0]
    if matches:
        shown = ", ".join(matches[:8]) + (", ..." if len(matches) > 8 else "")
        raise InputError(f"--change {key}: {len(matches)} parameters end in that; type one of: {shown}")
    if ".film." in f".{key}" or key.startswith("film."):
        raise InputError(f"--change {key}: the film stays as it is over a sequence; use --size")
    raise InputError(f"--change {key}: the scene has no such parameter; {_suggest(known, key)}")


def _suggest(known, key: str) -> str:
    parts = key.lower().split(".")
    close = [k for k in known if all(any(p in part for part in k.lower().split(".")) for p in parts)]
    close += difflib.get_close_matches(key, known, 4, 0.6)
    close += [k for k in known if k.lower().startswith(parts[0] + ".")]
    close = list(dict.fromkeys(close))[:6]
    if close:
        return f"close to it: {', '.join(close)}"
    return f"it has: {', '.join(list(known)[:12])}, ... (list(mi.traverse(scene).keys()) gives all)"


def _shines(node) -> bool:
    return node.class_name() in ("DirectionalEmitter", "SpotLight")


def _numbers(key: str, value: object) -> np.ndarray:
    """A Mitsuba value as a float64 array, see the head of this module for shapes."""
    import drjit as dr

    if isinstance(value, (bool, int, float)):
        return np.array(float(value))
    if dr.is_array_v(value):  # tested first: Dr.Jit reads `.matrix` of a colour as a swizzle
        numbers = np.array(value, np.float64)
        if dr.is_tensor_v(value) or numbers.size == 0:
            return numbers
        return numbers.reshape([n for n in numbers.shape if n != 1])
    if hasattr(value, "matrix"):
        numbers = np.array(value.matrix, np.float64)
        return numbers.reshape(numbers.shape[:2])
    raise InputError(f"--change {key}: a {type(value).__name__} cannot be changed from frame to frame")


def _assign(params, key: str, numbers: np.ndarray) -> None:
    """Set a parameter from an array, as evaluated data: with constants each frame would compile kernels of its own.

    Only what Mitsuba keeps as a plain number (``eta`` of a dielectric) remains one.
    """
    import drjit as dr

    current = params[key]
    if isinstance(current, (bool, int, float)):
        params[key] = type(current)(numbers)
    elif not dr.is_array_v(current) or dr.is_tensor_v(current):
        value = type(current)(np.ascontiguousarray(numbers, np.float32))
        dr.make_opaque(value)
        params[key] = value
    else:
        wide = numbers.reshape(numbers.shape or (1,))
        if dr.depth_v(current) > 1 and wide.ndim < dr.depth_v(current):
            wide = wide.reshape(*wide.shape, 1)
        integral = dr.is_integral_v(current)
        params[key] = type(current)(np.ascontiguousarray(np.round(wide) if integral else wide,
                                                         np.uint32 if integral else np.float32))  # fmt: skip


def _check_transform(matrix: np.ndarray) -> None:
    if not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0], atol=1e-6):
        raise ValueError(f"gives a matrix whose last row is {matrix[3].tolist()}, not [0, 0, 0, 1]")
    if abs(np.linalg.det(matrix[:3, :3])) < 1e-20:
        raise ValueError("gives a matrix that flattens everything (its determinant is 0)")


def digest(values: dict[str, np.ndarray]) -> str:
    """A hash of parameter values as Mitsuba will hold them (32 bit); "" for none."""
    if not values:
        return ""
    sha = hashlib.sha256()
    for key in sorted(values):
        sha.update(f"{key} {values[key].shape} ".encode())
        sha.update(np.ascontiguousarray(values[key] + 0.0, np.float32).tobytes())  # + 0: no negative zero
    return sha.hexdigest()[:12]


# ------------------------------------------------------------------------------------------------------------------
# Matrices


def rotate(axis, degrees: float, about=(0.0, 0.0, 0.0)) -> np.ndarray:
    """4x4 rotation around `axis` through the point `about`, counter-clockwise where the axis points to the viewer."""
    axis, about = _vector("rotate", axis), _vector("rotate", about)
    if np.linalg.norm(axis) == 0.0:
        raise ValueError("rotate: the axis is [0, 0, 0]")
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.radians(degrees)
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    matrix[:3, 3] = about - matrix[:3, :3] @ about
    return matrix


def translate(x, y=None, z=None) -> np.ndarray:
    """4x4 translation by (x, y, z), or by one vector."""
    matrix = np.eye(4)
    matrix[:3, 3] = _vector("translate", x if y is None else [x, y, z])
    return matrix


def scale(x, y=None, z=None) -> np.ndarray:
    """4x4 scaling by (x, y, z), by one vector, or by one number."""
    if y is None:
        factors = np.broadcast_to(np.asarray(x, np.float64), 3)
    else:
        factors = _vector("scale", [x, y, z])
    return np.diag([*factors, 1.0])


def rotated(vector, axis, degrees: float) -> np.ndarray:
    """A vector of shape (3,) after a rotation."""
    return rotate(axis, degrees)[:3, :3] @ _vector("rotated", vector)


def look_at(origin, target, up=(0.0, 1.0, 0.0)) -> np.ndarray:
    """4x4 placement of a camera or spot light at `origin` that looks at `target`, as Mitsuba's `look_at`."""
    origin, target, up = (_vector("look_at", v) for v in (origin, target, up))
    forward = target - origin
    left = np.cross(up, forward)
    if np.linalg.norm(left) == 0.0:
        raise ValueError("look_at: origin and target are the same, or `up` points along the view")
    forward, left = forward / np.linalg.norm(forward), left / np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3] = np.stack([left, np.cross(forward, left), forward, origin], axis=1)
    return matrix


def _vector(name: str, value) -> np.ndarray:
    vector = np.asarray(value, np.float64)
    if vector.shape != (3,):
        raise ValueError(f"{name}: expected three numbers, like [0, 1, 0], got {value}")
    return vector


# ------------------------------------------------------------------------------------------------------------------
# Expressions

#: What an expression may call or name, beside the variables of the frame.
FUNCTIONS = {
    **{name: getattr(np, name) for name in "sin cos tan exp log sqrt floor minimum maximum where clip array".split()},
    "abs": np.abs,
    "pi": np.pi,
    **{f.__name__: f for f in (rotate, translate, scale, rotated, look_at)},
}
VARIABLES = ("value", "frame", "n", "t", "after", "s")
_NODES = (
    ast.Expression, ast.BinOp, ast.UnaryOp, ast.Compare, ast.IfExp, ast.Call, ast.keyword, ast.Name, ast.Load,
    ast.Constant, ast.List, ast.Tuple, ast.Subscript, ast.Slice, ast.unaryop, ast.cmpop,
    # not <<, which makes integers of any length
    ast.Add, ast.Sub, ast.Mult, ast.MatMult, ast.Div, ast.FloorDiv, ast.Mod, ast.Pow, ast.BitAnd, ast.BitOr, ast.BitXor,
)  # fmt: skip


def expression(key: str, text: str, frames: int, change_at: int | None = None) -> Function:
    """The function of frame and value that `text` describes: Python arithmetic on

    value   the parameter's original value        frame   0 .. n-1          n   number of frames
    t       frame / (n - 1)                       after   1 from frame `change_at` on, else 0
    s       frames since then, at least 0

    with the names of `FUNCTIONS`, and ``bitmap("file_%04d.exr")`` for the image of this frame. Nothing else can be
    named, so that a text from an unknown source can do no harm. Raises :class:`InputError`.
    """
    where = f"--change {key}={text}"
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except SyntaxError as error:
        raise InputError(f"{where}: not an expression ({error.msg})") from None
    names = {*FUNCTIONS, *VARIABLES, "bitmap"}
    files = {id(a) for c in ast.walk(tree) if isinstance(c, ast.Call) and ast.unparse(c.func) == "bitmap"
             for a in c.args}  # fmt: skip
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id not in names:
            raise InputError(f"{where}: unknown name {node.id!r}; it may use {', '.join(sorted(names))}")
        is_text = isinstance(node, ast.Constant) and not isinstance(node.value, (int, float))
        if not isinstance(node, _NODES) or (is_text and id(node) not in files):
            raise InputError(f"{where}: {ast.unparse(node)!r} is not allowed; use arithmetic, lists, and the functions "
                             f"{', '.join(sorted({*FUNCTIONS, 'bitmap'}))}")  # fmt: skip
        if change_at is None and isinstance(node, ast.Name) and node.id in ("after", "s"):
            raise InputError(f"{where} uses {node.id!r}: say when, with --change-at FRAME")
    tree = ast.fix_missing_locations(_Bounded().visit(tree))
    code = compile(tree, where, "eval")

    def function(frame: int, value: np.ndarray) -> np.ndarray:
        since = frame - change_at if change_at is not None else 0
        variables = {
            "value": value, "frame": frame, "n": frames, "t": frame / max(frames - 1, 1),
            "after": int(change_at is not None and since >= 0), "s": max(since, 0),
            "bitmap": lambda pattern: bitmap(pattern, frame, value.shape), "_power": _power,
        }  # fmt: skip
        with np.errstate(all="ignore"):  # NaN and infinities are found afterwards
            return eval(code, {"__builtins__": {}}, {**FUNCTIONS, **variables})

    return function


def parse(texts: list[str], frames: int, change_at: int | None = None) -> dict[str, Function]:
    """Functions by key out of `KEY=EXPR` texts."""
    functions: dict[str, Function] = {}
    for text in texts:
        key, equals, expr = text.partition("=")
        key = key.strip()
        if not equals or not key or not expr.strip():
            raise InputError(f"--change takes KEY=EXPR, like lamp.radiance=value*(1+t); got {text!r}")
        if key in functions:
            raise InputError(f"--change {key} is given twice: write one expression")
        functions[key] = expression(key, expr.strip(), frames, change_at)
    return functions


class _Bounded(ast.NodeTransformer):
    """``a ** b`` in floating point, as integers of any length could take unlimited time, and lists as arrays, as
    ``[0] * n`` could take unlimited memory."""

    def visit_BinOp(self, node):
        left, right = (self._array(self.visit(side)) for side in (node.left, node.right))
        if isinstance(node.op, ast.Pow):
            return ast.Call(ast.Name("_power", ast.Load()), [left, right], [])
        return ast.BinOp(left, node.op, right)

    @staticmethod
    def _array(node):
        if isinstance(node, (ast.List, ast.Tuple)):
            return ast.Call(ast.Name("array", ast.Load()), [node], [])
        return node


def _power(base, exponent):
    return np.power(np.asarray(base, np.float64), exponent)


def bitmap(pattern: str, frame: int, shape: tuple[int, ...]) -> np.ndarray:
    """The image `pattern % frame` as linear values in the shape (height, width, channels) of a texture.

    An environment map repeats its last column before the first and its first column after the last; they are added to
    an image that lacks them.
    """
    import mitsuba as mi

    try:
        if re.search(r"%[^a-zA-Z%]*\d{3}", pattern):
            raise ValueError  # a name of so many letters
        name = pattern % frame if "%" in pattern else pattern
    except (TypeError, ValueError):
        raise ValueError(f"bitmap: {pattern!r} needs one place for the frame, like picture_%04d.exr") from None
    name = str(user_path(name))
    if not Path(name).is_file():
        raise ValueError(f"bitmap: there is no file {name}")
    if len(shape) != 3:
        raise ValueError(f"bitmap: this parameter is no texture, it has shape {shape}")
    formats = {1: mi.Bitmap.PixelFormat.Y, 3: mi.Bitmap.PixelFormat.RGB, 4: mi.Bitmap.PixelFormat.RGBA}
    try:
        image = np.array(mi.Bitmap(name).convert(formats[shape[2]], mi.Struct.Type.Float32, srgb_gamma=False))
    except (RuntimeError, KeyError) as error:
        raise ValueError(f"bitmap: cannot read {name} with {shape[2]} channels: {one_line(error)}") from None
    image = image.reshape(*image.shape[:2], -1)
    if (image.shape[0], image.shape[1] + 2) == shape[:2]:
        image = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
    return image
