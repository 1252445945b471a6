"""The image that others are compared with: read from a file, or rendered with Mitsuba's `path` and kept.

Scenes with participating media are rendered with `volpath`, which they need.

A reference carries its own noise: beside the mean its file holds `variance.R G B`, the variance *of that mean*,
estimated from the spread between passes.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_neural.image import exr
from mi_neural.image.metrics import block_means, count_nonfinite, relative_squared_errors

from .budget import STREAM_REFERENCE, Progress, clock, pass_seed, pixels, render_pass
from .load import InputError, LoadedScene, load_scene, split_channels, user_path
from .specs import IntegratorSpec, build_integrator

#: Passes hold about this many samples and at most MAX_PASS_SPP a pixel: many passes, or there is no variance to
#: estimate.
PASS_SAMPLES = 2**20
MAX_PASS_SPP = 16
#: An unfinished reference is written at least this often, in seconds.
SAVE_SECONDS = 60.0


@dataclass(frozen=True)
class Reference:
    """A reference image.

    rgb       float32, shape (height, width, 3)
    variance  variance of `rgb` per value, same shape, or None where the file has none
    metadata  attributes of the file: integrator, max_depth, spp
    path      the file
    seconds   time spent rendering it now; 0 where it was read
    clean     `rgb` after the denoiser, same shape; None: not made. FLIP has no way to subtract the noise of `rgb`
    """

    rgb: np.ndarray
    variance: np.ndarray | None
    metadata: dict[str, object]
    path: Path
    seconds: float = 0.0
    clean: np.ndarray | None = None

    def noise_floor(self) -> float | None:
        """What the noise of this reference adds to relMSE: mean of variance / (lum^2 + 1e-2), scaled. None: unknown."""
        if self.variance is None:
            return None
        return float(relative_squared_errors(self.rgb, self.rgb, self.variance)[1].mean())

    def standard_error(self) -> float | None:
        """Relative standard error of a pixel, as the root mean square over the image: the square root of
        :meth:`noise_floor`."""
        noise = self.noise_floor()
        return None if noise is None else noise**0.5

    def averaged(self, size: tuple[int, int]) -> Reference:
        """This reference for a film of `size`, (width, height), k times smaller: means of k x k pixels, whose noise is
        independent."""
        scale = self.rgb.shape[1] // size[0]
        variance = self.variance
        if variance is not None:
            variance = (block_means(variance, size[::-1]) / scale**2).astype(np.float32)
        rgb = block_means(self.rgb, size[::-1]).astype(np.float32)
        return Reference(rgb, variance, self.metadata | {"averaged": scale}, self.path, self.seconds)

    def to_json(self) -> dict[str, object]:
        """Its entry in `results.json`."""
        return {
            **self.metadata, "path": str(self.path), "noise_relmse": self.noise_floor(),
            "standard_error": self.standard_error(), "variance_subtracted": self.variance is not None,
            "seconds": self.seconds,
        }  # fmt: skip


def load_reference(path: str | Path, size: tuple[int, int] | None = None, scaled: bool = False) -> Reference:
    """Read a reference and check it against the size (width, height) that will be rendered.

    With `scaled` it may also be k times as large, k a whole number, and is then averaged over k x k pixels; or k times
    smaller: it is then returned as it is, and the caller averages the image (:func:`.metrics.block_means`). Both are
    right only for films with a box filter, whose pixels are such means.

    Raises :class:`InputError` where the file is missing or no EXR, has another size, or holds NaN or infinities.
    """
    path = user_path(path)
    try:
        image = exr.read(path)
    except FileNotFoundError:
        raise InputError(f"no reference {path}: leave --reference out or render one with --reference-spp") from None
    except (ValueError, OSError) as error:
        raise InputError(f"cannot read the reference: {error}") from None
    fits = size is None or image.size == tuple(size) or (scaled and scale_between(size, image.size) is not None)
    if not fits:
        (w, h), (rw, rh) = size, image.size
        raise InputError(
            f"the reference {path} is {rw}x{rh}, the image {w}x{h}: add --size {rw}x{rh} or choose another"
            + ("" if scaled or scale_between(size, image.size) is None else "; films with a box filter can be scaled")
        )
    if n := count_nonfinite(image.rgb):
        raise InputError(f"the reference {path} has {n} non-finite pixels and cannot be compared with: render it anew")
    variance = image.layer("variance")
    if variance is not None and not (np.isfinite(variance).all() and (variance >= 0.0).all()):
        raise InputError(f"the reference {path} has negative or non-finite values in variance.*: render it anew")
    found = Reference(image.rgb, variance, image.metadata, path)
    return found.averaged(size) if size is not None and image.size[0] > size[0] else found


def scale_between(size: tuple[int, int], other: tuple[int, int]) -> int | None:
    """How many times one of two sizes is the other, in both directions; None if that is no whole number."""
    (w, h), (ow, oh) = sorted((tuple(size), tuple(other)))
    return ow // w if ow % w == 0 and oh == h * (ow // w) else None


def beside(path: Path, size: tuple[int, int], scaled: bool = False) -> Path | None:
    """A reference of this size in the scene file's own folder: `reference_640x360.exr` for `scene.xml`, else
    `NAME_reference_640x360.exr`; None where there is none.

    With `scaled`, where no file has just this size, the next larger one that can be averaged to it, or else the next
    smaller one, see :func:`load_reference`.
    """
    start = "reference_" if path.stem == "scene" else f"{path.stem}_reference_"
    file = path.parent / f"{start}{size[0]}x{size[1]}.exr"
    if file.is_file():
        return file
    found = []
    for other in path.parent.glob(glob.escape(start) + "*x*.exr") if scaled else ():
        numbers = re.fullmatch(r"(\d+)x(\d+)", other.stem[len(start) :])
        if numbers and (scale := scale_between(size, (w := int(numbers[1]), int(numbers[2])))):
            found.append((w < size[0], scale, other))
    return min(found)[-1] if found else None


def with_scene(name: str, file: str | None, size: tuple[int, int] | None) -> tuple[LoadedScene, Reference]:
    """A scene and the image that it is compared with: `file`, or the one beside the scene.

    The scene has this `size`, else that of `file`, else its own. Raises :class:`InputError` where there is none.
    """
    if file is not None:
        reference = load_reference(file, size)
        return load_scene(name, size=size or reference.rgb.shape[1::-1]), reference
    loaded = load_scene(name, size=size)
    if (found := beside(loaded.path, loaded.size)) is None:
        width, height = loaded.size
        raise InputError(f"no reference of {width}x{height} lies beside {loaded.path}: add --reference FILE.exr")
    return loaded, load_reference(found, loaded.size)


def of_film(path: str | Path, loaded: LoadedScene) -> Reference:
    """:func:`load_reference` for what `loaded` will render, scaled where its film allows it."""
    return load_reference(path, loaded.size, loaded.box_filter)


def scale_note(reference: Reference, size: tuple[int, int]) -> str | None:
    """One line where this reference and images of `size` were not of one size, else None."""
    height, width = reference.rgb.shape[:2]
    if averaged := reference.metadata.get("averaged"):
        return f"Each pixel of the reference is a mean of {averaged}x{averaged} in {reference.path.name}."
    if (width, height) == tuple(size):
        return None
    n = size[0] // width
    return f"The reference is {width}x{height}: errors are those of means of {n}x{n} pixels; flicker is of single ones."


def cache_folder() -> Path:
    """Where references are kept for all comparisons of this user: under `XDG_CACHE_HOME`, by default `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME") or (os.environ.get("LOCALAPPDATA") if os.name == "nt" else None)
    return Path(base or Path.home() / ".cache") / "mi_neural" / "references"


def depth_warning(reference: Reference, max_depth: object, direct_only: bool = False) -> str | None:
    """One line where the reference was rendered at another depth, else None. -1 and above 1000 count as no limit.

    `direct_only`: whether the integrator shows light that was reflected once, whatever its depth.
    """

    def depth(value: object) -> float:
        number = float(value)
        return float("inf") if number < 0 or number > 1000 else number

    theirs = reference.metadata.get("max_depth")
    try:
        if direct_only and theirs is not None and depth(theirs) > 2:
            return (
                f"it renders light reflected once, the reference was rendered with max_depth {theirs} and holds more: "
                "add -D max_depth=2 if the scene has that parameter, else choose a reference of that depth"
            )
        if theirs is None or max_depth is None or depth(theirs) == depth(max_depth):
            return None
    except (TypeError, ValueError):
        return None
    return (
        f"max_depth is {max_depth}, the reference was rendered with {theirs}: for equal depth add "
        f"-D max_depth={theirs} if the scene has that parameter, else --set max_depth={theirs}"
    )


def pass_spp(scene) -> int:
    """Samples a pixel of one pass: a power of two that follows from the film, so that a reference can be continued."""
    spp = 1
    while spp * 2 <= MAX_PASS_SPP and spp * 2 * pixels(scene) <= PASS_SAMPLES:
        spp *= 2
    return spp


def reference_path(loaded: LoadedScene, folder: Path, state: str = "") -> Path:
    """Where the reference of this scene's files, these parameters, this film, this version of Mitsuba and this state of
    the scene is kept. The number of samples is not part of the name: it can grow."""
    import mitsuba as mi

    from mi_neural.render.media import media_of

    inputs = [loaded.digest, sorted(loaded.parameters.items()), loaded.size, sorted(loaded.carried.items())]
    inputs += [mi.__version__, *([state] if state else []), *(["volpath"] if media_of(loaded.scene) else [])]
    key = hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:12]
    return folder / f"reference_{loaded.name}_{key}.exr"


def render_reference(
    loaded: LoadedScene,
    spp: int,
    folder: Path,
    progress: Progress | None = None,
    seed: int = 0,
    state: str = "",
) -> Reference:
    """The reference for a scene with at least `spp` samples a pixel, by Mitsuba's `path` (`volpath` where there are
    participating media) at the scene's depth.

    Kept in `folder` under the name that :func:`reference_path` gives. One with enough samples is taken as it is, one
    with fewer is continued. For a scene whose parameters were changed in memory, give a `state` that tells these
    changes from others. On Ctrl-C the passes so far are written and ``KeyboardInterrupt`` goes on to the caller.
    """
    from mi_neural.render.media import media_of

    path, size = reference_path(loaded, folder, state), pass_spp(loaded.scene)
    n_passes = max(2, -(-spp // size))
    moments = _Moments.resume(path, size, loaded.size)
    start = saved = clock()
    if moments.n < n_passes:
        kind = "volpath" if media_of(loaded.scene) else "path"
        integrator, _ = build_integrator(IntegratorSpec(kind), loaded.carried)
        metadata = {
            "scene": loaded.name,
            "integrator": kind,
            "max_depth": str(loaded.carried.get("max_depth", -1)),
            "pass_spp": size,
        }
        try:
            while moments.n < n_passes:
                image = render_pass(loaded.scene, integrator, size, pass_seed(seed, STREAM_REFERENCE, moments.n))
                moments.add(split_channels(image, [])[0])
                if progress:
                    progress(moments.n * size, n_passes * size)
                if clock() - saved > SAVE_SECONDS:
                    moments.write(path, metadata)
                    saved = clock()
        finally:
            if moments.n >= 2:
                moments.write(path, metadata)
    reference = load_reference(path, loaded.size)
    return Reference(reference.rgb, reference.variance, reference.metadata, path, clock() - start)


class _Moments:
    """Mean and squared deviations of passes (Welford). A pixel that is not finite in a pass is left out of that pass.

    count   passes of each pixel that count, shape (height, width, 1)
    """

    def __init__(self) -> None:
        self.n = 0
        self.count: np.ndarray | float = 0.0
        self.size = 1
        self.mean: np.ndarray | float = 0.0
        self.squares: np.ndarray | float = 0.0

    @classmethod
    def resume(cls, path: Path, size: int, film: tuple[int, int]) -> _Moments:
        moments = cls()
        moments.size = size
        if not path.is_file():
            return moments
        try:
            kept = load_reference(path, film)
            n = int(kept.metadata["spp"]) // size
        except (InputError, KeyError, ValueError):
            return moments  # unreadable: render it anew
        if kept.variance is not None and n >= 2 and kept.metadata.get("pass_spp") == size:
            moments.n, moments.mean = n, kept.rgb.astype(np.float64)
            moments.count = np.full((*moments.mean.shape[:2], 1), float(n))
            moments.squares = kept.variance.astype(np.float64) * n * (n - 1)
        return moments

    def add(self, image: np.ndarray) -> None:
        finite = np.isfinite(image).all(axis=-1, keepdims=True)
        image = np.where(finite, image, self.mean)
        self.n += 1
        self.count = self.count + finite
        delta = image - self.mean
        self.mean = self.mean + delta / np.maximum(self.count, 1.0)
        self.squares = self.squares + delta * (image - self.mean)

    def variance(self) -> np.ndarray:
        """Variance of the mean."""
        return self.squares / np.maximum(self.count * (self.count - 1.0), 1.0)

    def write(self, path: Path, metadata: dict[str, object]) -> None:
        import mitsuba as mi

        metadata = {**metadata, "spp": str(self.n * self.size), "mitsuba": mi.__version__}
        exr.write(path, self.mean, exr.layer_channels("variance", self.variance()), metadata)
