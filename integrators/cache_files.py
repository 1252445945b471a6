"""Files of trained caches: what an integrator writes into one, and when it takes one up.

The functions are methods of :class:`~mi_neural.integrators.common.CacheIntegrator`.
"""

from __future__ import annotations

import hashlib

from mi_neural.caches.field import CacheFileError
from mi_neural.caches.files import damaged
from mi_neural.integrators import planning


def scene_signature(scene) -> str:
    """A short hash of what makes a scene another scene: its shapes, their primitives, its emitters and extent."""
    box = scene.bbox()
    facts = (
        sorted(int(s.primitive_count()) for s in scene.shapes()),
        len(scene.emitters()),
        [float(f"{float(v):.4g}") for v in (*box.min, *box.max)],
    )
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:16]


def other_scene(path) -> str:
    """What is said of the cache of another scene."""
    return (
        f"the cache in '{path}' was trained in another scene, or the geometry has changed since; "
        "train one for this scene, or type reset()"
    )


def save_cache(integrator, path) -> None:
    """Write the trained cache to `path`, whole or not at all."""
    if integrator.cache.field is None:
        raise RuntimeError(f"{integrator.plugin}: there is no cache to save yet; render an image or call train() first")
    integrator.cache.save(
        path, scene=integrator.state.signature, statistics=dict(integrator.cache.statistics), **integrator.file_facts()
    )


def load_cache(integrator, path, scene=None) -> None:
    """Go on from a cache file. With `scene`, or once a scene was rendered: refuse a cache of another scene.

    Raises `CacheFileError` (a ``ValueError``).
    """
    field, header, extra = integrator.cache.read(path)
    if not planning.fits(field.shape, integrator.cache.shape):
        raise CacheFileError(f"'{path}' holds a cache of {field.shape}, this integrator has {integrator.cache.shape}; "
                             "give it the same sizes")  # fmt: skip
    integrator.check_file(path, header)
    if scene is not None:
        integrator.bind(scene, integrator._sensor(scene, 0), train=False)
    known = integrator.state.signature
    if known is not None and header.get("scene") != known:
        raise CacheFileError(other_scene(path))
    try:
        integrator.cache.resume(field, header, extra)
    except (KeyError, TypeError, ValueError) as e:
        raise damaged(path, e) from None
    integrator.state.loaded, integrator.state.begun = (path, header.get("scene")), False
    if field.shape != integrator.cache.shape:
        integrator.cache.shape = field.shape
        integrator.cache.clear_recordings()
        integrator.film_state.passes.clear()
