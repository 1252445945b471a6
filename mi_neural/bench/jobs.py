"""Jobs for another process: a part of an image, a frame of a sequence, the rows of one case.

A job is plain data, and its result follows from it and from the bytes that come with it (a cache file). The process
that runs it keeps the last scene and integrator, for jobs that follow. Here is nothing of Dask, which only hands jobs
out (:mod:`mi_neural.bench.cluster`): in the process that made it, a job runs the same way.
"""

from __future__ import annotations

import gc
import hashlib
import tempfile
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

from mi_neural.image.moments import Moments

from . import benchmark, budget, changes, denoise, environment
from .load import InputError, LoadedScene, find_scene, load_scene
from .reference import Reference
from .sequence import STREAM_FRAMES, Sequence
from .specs import IntegratorSpec, build_integrator

#: Statistics of integrators that are sums over images.
COUNTS = ("queries", "nonfinite")


@cache
def versions() -> dict[str, str]:
    """What must be the same in all processes whose results are put together."""
    import drjit as dr
    import mitsuba as mi

    import mi_neural
    from mi_neural import emitters, integrators

    sources = hashlib.sha256()
    for package in (mi_neural, integrators, emitters):
        folder = Path(package.__path__[0])
        for file in sorted(folder.rglob("*.py"), key=lambda file: file.relative_to(folder).as_posix()):
            sources.update(file.read_bytes())
    return {
        "mi_neural": f"{mi_neural.__version__} (sources {sources.hexdigest()[:8]})",
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
    }


# ------------------------------------------------------------------------------------------------------------------
# Scene and integrator


@dataclass(frozen=True)
class Setup:
    """A scene and an integrator, as another process can make them anew.

    scene       name of a shipped scene, or the path of a file that the other process must see as well
    digest      of that file and those that it names
    size        (width, height) of the film, None: the scene's own
    parameters  values for the scene's `$parameters`
    merge       as for :func:`load_scene`
    spec        the integrator as it was typed
    keys        all keys that it has, the scene's depth with them
    own         it is the one that the scene file itself names, with `spec.keys` set
    """

    scene: str
    digest: str
    size: tuple[int, int] | None
    parameters: dict[str, str]
    merge: bool
    spec: IntegratorSpec
    keys: dict[str, object]
    own: bool
    variant: str
    versions: dict[str, str] = field(default_factory=versions)

    @classmethod
    def of(cls, loaded: LoadedScene, case: benchmark.Case, size=None, merge: bool = True, own: bool = False) -> Setup:
        """The setup of what was loaded here."""
        import mitsuba as mi

        from mi_neural import scenes

        shipped = loaded.path.stem in scenes.names() and find_scene(loaded.path.stem) == loaded.path
        name = loaded.path.stem if shipped else str(loaded.path)
        return cls(name, loaded.digest, size, loaded.parameters, merge, case.spec, case.keys, own, mi.variant())

    def check(self) -> None:
        """Raise :class:`InputError` where this process cannot give the results of this setup."""
        for name, version in versions().items():
            if version != self.versions[name]:
                raise InputError(
                    f"it has {name} {version}, the process that sent the job has {self.versions[name]}: install the "
                    "same there"
                )
        try:
            find_scene(self.scene)
        except InputError:
            raise InputError(
                f"it sees no file {self.scene}: put scene, meshes and textures where all workers see them by the same "
                "path"
            ) from None


class Workbench:
    """The scene and the integrator of the last job of this process.

    setup     what they were made from; None: the integrator is not there (any more)
    of_scene  what the scene was made from
    """

    def __init__(self) -> None:
        self.setup: Setup | None = None
        self.of_scene: Setup | None = None
        self.loaded: LoadedScene | None = None
        self.case: benchmark.Case | None = None
        self.cache: bytes | None = None
        self.sequence: Sequence | None = None
        self.sequence_key: tuple | None = None

    def ready(self, setup: Setup, fresh: bool = False) -> tuple[LoadedScene, benchmark.Case]:
        """Scene and integrator of a setup; those of the last one as far as they are the same.

        `fresh`: an integrator that has neither rendered nor trained, and whose cache may train.
        """
        import mitsuba as mi

        if setup == self.setup and not fresh:
            return self.loaded, self.case
        setup.check()
        same_scene = self.of_scene is not None and not (setup.own or self.of_scene.own)
        same_scene = same_scene and setup == replace(self.of_scene, spec=setup.spec, keys=setup.keys)
        self.setup = self.of_scene = self.case = self.cache = None
        if not same_scene:
            # Released before the next one is loaded: all emitters that are alive are compiled into every kernel
            self.loaded = self.sequence = self.sequence_key = None
        gc.collect()
        mi.set_variant(setup.variant)
        if not same_scene:
            own_keys = setup.spec.keys if setup.own else None
            self.loaded = load_scene(setup.scene, setup.size, setup.parameters, own_keys, setup.merge)
            if self.loaded.digest != setup.digest:
                raise InputError(
                    f"its {self.loaded.path}, or a file that it names, is not the one here: put the same there"
                )
        if setup.own:
            self.case = benchmark.own_case(self.loaded, setup.spec.keys)
        else:
            integrator, keys = build_integrator(IntegratorSpec(setup.spec.type, setup.keys))
            self.case = benchmark.Case(setup.spec, integrator, keys)
        self.setup = self.of_scene = setup
        return self.loaded, self.case

    def learned(self, cache: bytes | None, over_time: Sequence | None = None) -> None:
        """Load the cache of those bytes into the integrator, which does not train any more after that.

        It is bound to the scene in the state of frame 0 of `over_time`, as it was where it was trained.
        """
        integrator = self.case.integrator
        if hasattr(integrator, "freeze_cache"):
            integrator.freeze_cache = True
        if cache is None or cache == self.cache:
            return
        if over_time is not None:
            over_time.apply(0)
        with tempfile.TemporaryDirectory(prefix="mi-neural-") as folder:
            path = Path(folder) / "cache.npz"
            path.write_bytes(cache)
            integrator.load_cache(str(path))
        integrator.train(self.loaded.scene, 0)  # refuses a cache of another scene
        self.cache = cache

    def changing(self, texts: tuple[str, ...], frames: int, change_at: int | None) -> Sequence:
        """The scene as a sequence of those changes."""
        key = (texts, frames, change_at)
        if key != self.sequence_key:
            if self.sequence is not None:
                self.sequence.restore()
            functions = changes.parse(list(texts), frames, change_at)
            self.sequence, self.sequence_key = Sequence(self.loaded.scene, functions, frames, change_at), key
        return self.sequence


workbench = Workbench()


def cache_bytes(integrator) -> bytes | None:
    """What an integrator has learned, as the bytes of a cache file; None where there is nothing to be learned."""
    if not hasattr(integrator, "save_cache"):
        return None
    with tempfile.TemporaryDirectory(prefix="mi-neural-") as folder:
        path = Path(folder) / "cache.npz"
        try:
            integrator.save_cache(str(path))
        except RuntimeError:  # settings with which no cache is ever queried
            return None
        return path.read_bytes()


# ------------------------------------------------------------------------------------------------------------------
# Jobs


@dataclass(frozen=True)
class Part:
    """Some passes of an image of `spp` samples a pixel: those with the numbers from `first` on."""

    setup: Setup
    first: int
    passes: tuple[int, ...]
    spp: int
    seed: int

    def run(self, cache: bytes | None = None) -> tuple[Moments, dict[str, int]]:
        """The passes' moments, and what the integrator counted meanwhile."""
        loaded, case = workbench.ready(self.setup)
        workbench.learned(cache)
        film, before = Moments(), budget.statistics(case.integrator)
        budget.render_passes(
            loaded.scene, case.integrator, list(self.passes), self.spp, first=self.first, seed=self.seed, film=film
        )
        after = budget.statistics(case.integrator)
        return film, {name: after[name] - before.get(name, 0) for name in COUNTS if name in after}


@dataclass(frozen=True)
class Frame:
    """One frame of a sequence, whose integrator does not train between frames. `changes`: as typed, `KEY=EXPR`."""

    setup: Setup
    changes: tuple[str, ...]
    frames: int
    change_at: int | None
    frame: int
    spp: int
    seed: int

    def run(self, cache: bytes | None = None) -> tuple[budget.Rendered, float]:
        """The frame, and the seconds that it took to change the scene."""
        loaded, case = workbench.ready(self.setup)
        over_time = workbench.changing(self.changes, self.frames, self.change_at)
        workbench.learned(cache, over_time)
        start = budget.clock()
        over_time.apply(self.frame)
        seconds_update = budget.clock() - start
        seed = budget.pass_seed(self.seed, STREAM_FRAMES, self.frame)
        return budget.render_samples(loaded.scene, case.integrator, self.spp, seed), seconds_update


@dataclass(frozen=True)
class Measurement:
    """All rows of one integrator of a comparison."""

    setup: Setup
    plan: benchmark.Plan

    def run(self, shared: tuple[Reference, denoise.Guides | None]) -> list[benchmark.Picture]:
        """The rows with their pictures; `shared`: what all integrators are compared with, and denoised by."""
        reference, guides = shared
        if guides is not None:
            denoise.require()
        loaded, case = workbench.ready(self.setup, fresh=True)
        workbench.setup = None  # the bench trains the integrator, and releases it
        pictures: list[benchmark.Picture] = []
        bench = benchmark.Bench(loaded, reference, guides, environment.describe(), pictures.append)
        bench.run([case], self.plan)
        return pictures
