"""What the tests of outgoing radiance share: random surfaces, a function to learn, a small field and a small cache."""


import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.caches.outgoing_field import OutgoingField, OutgoingShape
from mi_neural.caches.radiance_cache import CacheInput, DispatchFlags, RadianceCache

TINY = OutgoingShape(
    n_levels=2, hashmap_size=128, base_resolution=3, direction_degree=1, normal_degree=1, width=8, n_hidden=1
)
BOX = ([-1.0, -2.0, 0.0], [1.0, 2.0, 5.0])
INFERENCE, TRAINING, RESET = DispatchFlags.INFERENCE, DispatchFlags.TRAINING, DispatchFlags.RESET
RATE, SMOOTHING = DispatchFlags.OVERRIDE_LEARNING_RATE, DispatchFlags.OVERRIDE_WEIGHT_SMOOTHING
CLEAR_I, CLEAR_T = DispatchFlags.CLEAR_INFERENCE_COUNTER, DispatchFlags.CLEAR_TRAINING_COUNTER


def surfaces(n: int, seed: int = 0) -> tuple:
    """Random surface points as NumPy arrays: position, normal, view direction, albedo, roughness."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(*BOX, (n, 3))
    directions = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, n, 3))]
    return x, *directions, rng.uniform(0.1, 0.9, (n, 3)), rng.uniform(0.05, 1, n)


def truth(x, n, w, albedo, roughness) -> np.ndarray:
    """A function of all inputs, about 1 times the albedo."""
    shade = 1 + 0.5 * np.sin(2 * x[:, 0]) * np.cos(x[:, 1]) + 0.3 * n[:, 2]
    gloss = (1 - roughness) * (w[:, 0] + 0.5 * w[:, 1])
    return albedo * np.stack([shade + 0.3 * gloss, shade, shade - 0.3 * gloss], axis=-1)


def jit(points) -> tuple:
    """Surface points as Dr.Jit arrays."""
    x, n, w, albedo, roughness = (np.asarray(v, "f4") for v in points)
    return mi.Point3f(x.T), mi.Vector3f(n.T), mi.Vector3f(w.T), mi.Color3f(albedo.T), mi.Float(roughness)


def make(shape=TINY, **kw) -> OutgoingField:
    return OutgoingField(*BOX, shape, **kw)


def learn(field, steps, rate=1e-2, smoothing=0.9, n=2048, first=0, factor=1.0, change=lambda target: target) -> list:
    """Steps on `truth`; the losses."""
    losses = []
    for k in range(first, first + steps):
        points = surfaces(n, 100 + k)
        target = mi.Color3f(change((truth(*points) * factor).astype("f4")).T)
        rate_, smoothing_ = dr.opaque(mi.Float, rate), dr.opaque(mi.Float, smoothing)
        losses.append(field.learn(*jit(points), target, mi.Bool(True), rate_, smoothing_)[0][0])
    return losses


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


def close(a, b, tolerance=2e-3) -> bool:
    """Whether two fields answer alike, up to the order in which threads sum up gradients."""
    points = jit(surfaces(1024, 9))
    a, b = (np.array(f.query(*points)) for f in (a, b))
    return np.sqrt(np.mean((a - b) ** 2)) < tolerance * np.abs(b).mean()


def make_cache(n=512, **kw) -> RadianceCache:
    return RadianceCache(n, n, *BOX, shape=kw.pop("shape", TINY), **kw)


def batch(cache, n=512, seed=0) -> tuple:
    """Packed points and what is true there, as NumPy arrays."""
    points = surfaces(n, seed)
    return cache.pack(*points), truth(*points)


def cache_inputs(packed: np.ndarray) -> CacheInput:
    """The same points as Dr.Jit arrays."""
    c = packed.T
    return CacheInput(mi.Point3f(c[:3]), mi.Vector2f(c[3:5]), mi.Vector2f(c[5:7]), mi.Color3f(c[7:10]), mi.Float(c[10]))


def train(cache, steps, flags=TRAINING, first=0, n=512, **kw) -> None:
    for k in range(first, first + steps):
        points, radiance = batch(cache, n, 100 + k)
        cache.dispatch(flags | TRAINING, train_inputs=points, train_targets=radiance, **kw)


def weights(cache) -> dict:
    return {**cache.field.snapshot(), "scale": np.array(cache.field.scale), "eta": np.array(cache.field.eta)}
