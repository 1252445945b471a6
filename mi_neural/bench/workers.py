"""Jobs on the workers of a Dask scheduler, and what they answer."""

from __future__ import annotations

import pickle
import queue
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial

from . import environment
from .load import InputError, one_line

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
