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

import pickle
import queue
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from mi_neural.image import exr
from mi_neural.image.moments import Moments

from . import benchmark, budget, environment, jobs, sequence
from .load import InputError, LoadedScene, load_scene, one_line, parse_integrator, split_channels

#: Fewest passes of an image that has so many samples: the variance is estimated from their spread.
LEAST_PASSES = 16
#: Parts of an image for each worker. More share the work more evenly, fewer send less.
PARTS_PER_WORKER = 8
#: Seconds to wait for the scheduler's answer, and for a worker where there is none (any more).
CONNECT_SECONDS, PATIENCE = 10.0, 60.0
#: Seconds between two checks which workers are there, and the most that an answer may take to be sent.
LOOK_SECONDS, FETCH_SECONDS = 1.0, 300.0
#: Workers that a job may lose; with one more, the job is taken to be the reason.
LOSSES = 3


class ClusterError(InputError):
    """The cluster cannot do what was requested; the message is one line and complete."""


class JobError(ClusterError):
    """One job cannot be done, on whatever worker."""


# ------------------------------------------------------------------------------------------------------------------
# On a worker


@dataclass
class Answer:
    """What a job gave, and on which worker; `environment` as of a measurement."""

    value: object
    worker: str
    environment: dict[str, object]


@cache
def _renderer(threads: int) -> ThreadPoolExecutor:
    """The only thread of a worker process that calls Mitsuba: jobs queue up, however many Dask hands out."""
    import drjit as dr

    return ThreadPoolExecutor(1, "mi_neural", dr.set_thread_count, (threads,))


def work(job, packed: bytes | None = None) -> Answer:
    """Run a job, with the pickled data that comes with it, on the worker that this is called on.

    What goes wrong comes back as one line.
    """
    from distributed import get_worker

    worker = get_worker()
    name = f"{worker.address} ({socket.gethostname()})"
    data = () if packed is None else (pickle.loads(packed),)

    def run() -> Answer:
        return Answer(job.run(*data), worker.address, environment.describe())

    try:
        return _renderer(worker.state.nthreads).submit(run).result()
    except Exception as error:
        expected = isinstance(error, (ValueError, OSError, ImportError, RuntimeError))
        text = one_line(error) if expected else f"{type(error).__name__}: {one_line(error)}"
        raise JobError(f"worker {name}: {text}") from error


def _by_value() -> Callable:
    """A function that calls what was pickled. It is nested and therefore sent as code: the scheduler unpickles each
    task, and would import this package, and Mitsuba with it, for a function of a module."""

    def call(packed: bytes, *data):
        import pickle

        return pickle.loads(packed)(*data)

    return call


# ------------------------------------------------------------------------------------------------------------------
# Here


def _distributed():
    try:
        import distributed
    except ImportError:
        raise ImportError("a cluster needs Dask; type: pip install 'mi_neural[cluster]'") from None
    return distributed


@contextmanager
def connect(client, patience: float = PATIENCE):
    """The :class:`Workers` of a ``distributed.Client``, or of a scheduler's address; None: this process alone.

    Raises ``ImportError`` without `distributed`, :class:`ClusterError` where no scheduler answers.
    """
    if client is None:
        yield None
        return
    distributed = _distributed()
    if not isinstance(client, str):
        yield Workers(client, patience)
        return
    try:
        # First, since a Client of an address that makes no sense cannot be discarded
        address = distributed.comm.normalize_address(client)
        distributed.comm.get_address_host_port(address, strict=True)
        made = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterError(
            f"no Dask scheduler answers at {client!r} ({one_line(error)}): type `dask scheduler` on that machine, give "
            "the address that it prints, like tcp://HOST:8786"
        ) from None
    with made:
        yield Workers(made, patience)


class Workers:
    """The worker processes of a cluster, each with one job of ours at a time."""

    def __init__(self, client, patience: float = PATIENCE) -> None:
        self.client, self.patience = client, patience
        self.address = client.scheduler.address

    def names(self) -> list[str]:
        """Addresses of the workers that are there now."""
        try:
            return list(self.client.nthreads())
        except (OSError, RuntimeError, ValueError) as error:
            raise self._no_scheduler(error) from None

    def count(self) -> int:
        """Number of workers; waits for the first one. Raises :class:`ClusterError` if none comes."""
        start = time.monotonic()
        while not (names := self.names()):
            self._still_hope(start)
            time.sleep(LOOK_SECONDS / 4)
        return len(names)

    def map(self, jobs_and_data: list[tuple[object, object]]) -> Iterator[tuple[int, Answer | JobError]]:
        """Run jobs, each with its data (None: without; one object is sent once, for however many jobs).

        Yields (index, answer) as they are done, in any order; a job that failed gives its error. A job whose worker
        dies is given to another. If the caller stops iterating, by an exception or otherwise, jobs that have not begun
        are cancelled. Raises :class:`ClusterError`: a job lost several workers, no worker or no scheduler is there any
        more.
        """
        waiting, finished, call = deque(range(len(jobs_and_data))), queue.SimpleQueue(), _by_value()
        running: dict[object, tuple[int, str]] = {}  # future -> job, worker
        losses: Counter[int] = Counter()
        seen = time.monotonic()
        sent: dict[int, object] = {}  # id of data -> future

        def hand_out(names: list[str]) -> None:
            busy = {name for _, name in running.values()}
            for name in names:
                if waiting and name not in busy:
                    index = waiting.popleft()
                    job, data = jobs_and_data[index]
                    if data is not None and id(data) not in sent:
                        sent[id(data)] = self._send(data)
                    further = () if data is None else (sent[id(data)],)
                    packed = pickle.dumps(partial(work, job))
                    future = self.client.submit(call, packed, *further, workers=[name], pure=False)
                    running[future] = index, name
                    future.add_done_callback(finished.put)

        def lost(index: int, name: str) -> None:
            # The worker is named: if Dask chooses among workers, it may put two jobs on one of them
            losses[index] += 1
            if losses[index] > LOSSES:
                raise ClusterError(
                    f"a job lost {losses[index]} workers, one after the other, the last at {name}: look at their logs; "
                    "if memory was too small, start them with a larger --memory-limit"
                )
            waiting.appendleft(index)

        try:
            while waiting or running:
                names = self.names()
                seen = time.monotonic() if names else seen
                self._still_hope(seen)
                for future, (index, name) in list(running.items()):
                    if name not in names:
                        del running[future]
                        future.cancel()
                        lost(index, name)
                hand_out(names)
                try:
                    future = finished.get(timeout=LOOK_SECONDS)
                except queue.Empty:
                    continue
                if future in running:  # else it was given to another worker
                    index, name = running.pop(future)
                    hand_out(names)  # the worker goes on while its answer is fetched
                    if (answer := self._fetch(future, name)) is None:
                        lost(index, name)
                    else:
                        yield index, answer
        finally:
            if running and self.client.status == "running":
                self.client.cancel(list(running), force=True)

    def run(self, jobs_and_data: list[tuple[object, object]]) -> Iterator[tuple[int, Answer]]:
        """As :meth:`map`, for jobs that are of use only together: the first that fails ends all."""
        for index, answer in self.map(jobs_and_data):
            if isinstance(answer, JobError):
                raise answer
            yield index, answer

    def _send(self, data):
        """Data as a future. It is the result of a task, which Dask repeats where all workers that held it are gone;
        scattered data would be lost."""
        import dask

        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "4 GiB"}):
            return self.client.submit(bytes, pickle.dumps(data), pure=False)

    def _fetch(self, future, name: str) -> Answer | JobError | None:
        """The answer of a job that is done, from the worker `name`; None where that has died since.

        Dask does not tell a dead worker from an answer that takes long to be sent. So this checks whether the worker is
        there after LOOK_SECONDS, and then after twice as long each time, since an answer that was interrupted is sent
        from the beginning.
        """
        distributed = _distributed()
        if not future.done():
            return None
        seconds = LOOK_SECONDS
        try:
            while seconds <= FETCH_SECONDS:
                try:
                    return future.result(timeout=seconds)
                except distributed.TimeoutError:
                    if name not in self.names():
                        return None
                    seconds *= 2
            return None
        except JobError as error:
            return error
        except distributed.KilledWorker:
            return None
        except ModuleNotFoundError as error:
            raise ClusterError(
                f"a worker cannot import {error.name}: in its environment type pip install 'mi_neural[cluster]'"
            ) from None
        except (distributed.CancelledError, OSError) as error:
            raise self._no_scheduler(error) from None

    def _still_hope(self, since: float) -> None:
        if time.monotonic() - since > self.patience:
            raise ClusterError(
                f"no worker at {self.address} for {self.patience:g} s: start one with "
                f"`dask worker {self.address} --nthreads N`"
            )

    def _no_scheduler(self, error: BaseException) -> ClusterError:
        return ClusterError(
            f"the scheduler at {self.address} does not answer any more ({one_line(error)}): start it again with `dask "
            "scheduler`, and the workers after it"
        )


# ------------------------------------------------------------------------------------------------------------------
# One image in parts


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
