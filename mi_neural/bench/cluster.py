"""Beyond one machine: jobs on the workers of a Dask scheduler, and images put together from parts.

    dask scheduler                                  # on one machine; prints its address
    dask worker tcp://HOST:8786 --nthreads 8        # on each machine, with mi_neural installed

    from mi_neural.bench import cluster
    image = cluster.render("scene.xml", "nirc", spp=4096, client="tcp://HOST:8786")

A worker process renders with `--nthreads` threads and has one job at a time. The cache is trained here, once, and its
file's bytes go to the workers, which train no more. An image is divided into passes as one process would divide it,
with the same random numbers, and merged by sample count (:class:`~mi_neural.image.moments.Moments`): it is the image
of one process up to the order of summation, except for what a worker measures or learns by itself (a light sampler's
visibility, the pilot of `nirc_two_level`), which changes noise and no mean.

A worker that dies is replaced: its job goes to another, and its nanny (Dask's) starts it anew. Needs the extra
`cluster` (`distributed`); the scheduler itself needs nothing of this package.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from mi_neural.image import exr
from mi_neural.image.moments import Moments

from . import benchmark, budget, jobs, sequence
from .load import InputError, LoadedScene, load_scene, split_channels
from .specs import parse_integrator
from .workers import PATIENCE, Answer, ClusterError, Workers, connect

#: Fewest passes of an image that has so many samples: the variance is estimated from their spread.
LEAST_PASSES = 16
#: Parts of an image for each worker. More share the work more evenly, fewer send less.
PARTS_PER_WORKER = 8


def plan_passes(scene, spp: int) -> list[int]:
    """Samples a pixel of each pass: those of :func:`budget.plan_passes` if they are LEAST_PASSES, else smaller ones.

    They depend on film and `spp` alone, not on the number of workers.
    """
    passes = budget.plan_passes(scene, spp)
    if len(passes) >= LEAST_PASSES:
        return passes
    size = 1
    while 2 * size * LEAST_PASSES <= spp:
        size *= 2
    return [size] * (spp // size) + ([spp % size] if spp % size else [])


def plan_parts(setup: jobs.Setup, passes: list[int], n_parts: int, seed: int) -> list[jobs.Part]:
    """Neighbouring passes as `n_parts` jobs, or as many as there are passes."""
    n_parts = max(1, min(n_parts, len(passes)))
    edges = [k * len(passes) // n_parts for k in range(n_parts + 1)]
    return [jobs.Part(setup, a, tuple(passes[a:b]), sum(passes), seed) for a, b in pairwise(edges)]


def check(case: benchmark.Case, over_time: bool = False) -> None:
    """Raise :class:`ClusterError` where parts of an image (`over_time`: frames) cannot be rendered separately."""
    integrator, name = case.integrator, case.spec.type
    if getattr(integrator, "cumulative", False):
        raise ClusterError(f"{name} makes its image of all samples together (mode=progressive): leave the mode out")
    if getattr(integrator, "history", 0) > 0:
        raise ClusterError(f"{name} reuses the images before (history={integrator.history:g}): add history=0")
    if over_time and getattr(integrator, "train_steps", 0) > 0 and not getattr(integrator, "freeze_cache", False):
        raise ClusterError(
            f"{name} trains before each frame (train_steps={integrator.train_steps}): add train_steps=0, with which it "
            "trains before the first one only"
        )


def render_samples(
    setup: jobs.Setup,
    loaded: LoadedScene,
    case: benchmark.Case,
    spp: int,
    seed: int = 0,
    workers: Workers | None = None,
    progress: budget.Progress | None = None,
    keep: Callable[[budget.Rendered], None] | None = None,
) -> budget.Rendered:
    """`spp` samples a pixel by all workers, with what the case's integrator has learned; None: by this process.

    As :func:`budget.render_samples`, with these differences. Channels `variance.R G B` hold the variance of the mean.
    `seconds_render` is wall time here, the workers' compiling included; `statistics` count their `queries`, and say how
    many `workers` and `parts` there were. Ctrl-C, and the loss of all workers, leave the image of the parts that are
    done; `problem` says so.

    Raises :class:`ClusterError`.
    """
    passes = plan_passes(loaded.scene, spp)
    if workers is None:
        film = Moments()
        rendered = budget.render_passes(
            loaded.scene, case.integrator, passes, spp, seed=seed, progress=progress, keep=keep, film=film
        )
        return _with_variance(rendered, case.integrator, film)
    check(case)
    merged = _Merged(case.integrator)
    kept = budget.clock()
    try:
        parts = plan_parts(setup, passes, PARTS_PER_WORKER * workers.count(), seed)
        learned = jobs.cache_bytes(case.integrator)
        for _, answer in workers.run([(part, learned) for part in parts]):
            merged.add(answer)
            if progress:
                progress(merged.film.spp, spp)
            if keep is not None and budget.clock() - kept > budget.KEEP_SECONDS:
                keep(merged.result(interrupted=True))
                kept = budget.clock()
    except KeyboardInterrupt:
        return merged.result(interrupted=True)
    except ClusterError as error:
        if not merged.film.spp:
            raise
        return merged.result(interrupted=True, problem=str(error))
    return merged.result()


class _Merged:
    """The parts of an image that are done."""

    def __init__(self, integrator) -> None:
        self.integrator, self.film, self.start = integrator, Moments(), budget.clock()
        self.counts: Counter[str] = Counter()
        self.parts: Counter[str] = Counter()

    def add(self, answer: Answer) -> None:
        film, counts = answer.value
        self.film.merge(film)
        self.counts.update(counts)
        self.parts[answer.worker] += 1

    def result(self, **ended) -> budget.Rendered:
        if not self.film.spp:
            raise KeyboardInterrupt("interrupted before the first samples were there")
        rendered = budget.Rendered(
            rgb=None, channels={}, spp=self.film.spp, nonfinite=self.film.nonfinite,
            seconds_train=0.0, seconds_render=budget.clock() - self.start,
            statistics={
                **budget.statistics(self.integrator), **self.counts,
                "workers": len(self.parts), "parts": self.parts.total(),
            }, **ended,
        )  # fmt: skip
        return _with_variance(rendered, self.integrator, self.film)


def _with_variance(rendered: budget.Rendered, integrator, film: Moments) -> budget.Rendered:
    """The image of `film`, with the variance of its mean among the channels."""
    names = list(integrator.aov_names()) if hasattr(integrator, "aov_names") else []
    rgb, channels = split_channels(film.mean(), names)
    channels = {name: values.astype(np.float32) for name, values in channels.items()}
    if (variance := film.variance()) is not None:
        channels.update(exr.layer_channels("variance", split_channels(variance, names)[0].astype(np.float32)))
    return replace(rendered, rgb=rgb.astype(np.float32), channels=channels)


def frames_of(
    workers: Workers, loaded: LoadedScene, size: tuple[int, int] | None, texts: list[str], over_time: sequence.Sequence,
    plan: sequence.Plan,
) -> Callable[[benchmark.Case, range], Iterator[sequence.Frame]]:  # fmt: skip
    """What has the workers render frames for a :class:`sequence.Run`; `texts`: the changes as typed, `KEY=EXPR`."""

    def render(case: benchmark.Case, frames: range) -> Iterator[sequence.Frame]:
        setup = jobs.Setup.of(loaded, case, size, merge=loaded.merged)
        of_all = (setup, tuple(texts), over_time.frames, over_time.change_at)
        learned = jobs.cache_bytes(case.integrator)
        of_frames = [(jobs.Frame(*of_all, frame, plan.spp, plan.seed), learned) for frame in frames]
        early: dict[int, sequence.Frame] = {}
        following = 0
        for index, answer in workers.run(of_frames):
            rendered, seconds_update = answer.value
            early[index] = sequence.Frame(rendered, seconds_update, answer.environment)
            while following in early:
                yield early.pop(following)
                following += 1

    return render


def render(
    scene: str | Path,
    integrator: str | None = None,
    spp: int | None = None,
    *,
    size: tuple[int, int] | None = None,
    parameters: dict[str, str] | None = None,
    pretrain: int = 0,
    cache: str | Path | None = None,
    seed: int = 0,
    client=None,
    patience: float = PATIENCE,
    progress: budget.Progress | None = None,
) -> budget.Rendered:
    """Render a scene file, or a shipped scene, on a cluster.

    integrator  `nirc` or `nirc:termination=auto,cache_samples=8`; None: the scene's own
    spp         samples a pixel; None: what the scene says
    size        (width, height) of the film; None: the scene's own
    parameters  values for the scene's `$parameters`
    pretrain    frames to train here before; what the integrator itself trains before a first image comes on top
    cache       a cache file to start from
    client      a ``distributed.Client``, the address of a scheduler, or None: this process renders all by itself
    patience    seconds to wait for a worker where there is none (any more)
    progress    called with (samples a pixel done, all)

    Returns a :class:`~mi_neural.bench.budget.Rendered`: `rgb` of shape (height, width, 3), and the variance of that
    mean in ``channels["variance.R"]``, `G`, `B`. Raises :class:`InputError` and :class:`ClusterError`.
    """
    import mitsuba as mi

    if mi.variant() is None:
        raise InputError('no Mitsuba variant is set; type: mi.set_variant("llvm_ad_rgb")')
    loaded = load_scene(str(scene), size, parameters)
    if integrator is None:
        case = benchmark.own_case(loaded, {})
    else:
        case = benchmark.make_cases(loaded, [parse_integrator(integrator)])[0]
    with connect(client, patience) as workers:
        if cache is not None:
            case.integrator.load_cache(str(cache), loaded.scene)
        seconds_train, stopped = budget.train(loaded.scene, case.integrator, pretrain)
        if not stopped:
            seconds_first, stopped = budget.train_first(loaded.scene, case.integrator)
            seconds_train += seconds_first
        if stopped:
            raise KeyboardInterrupt("interrupted while training")
        setup = jobs.Setup.of(loaded, case, size, own=integrator is None)
        rendered = render_samples(setup, loaded, case, spp or loaded.default_spp, seed, workers, progress)
    return replace(rendered, seconds_train=rendered.seconds_train + seconds_train)
