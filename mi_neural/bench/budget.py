"""Rendering to a number of samples or within a time, in passes.

Dr.Jit works asynchronously: the clock is read after ``dr.sync_thread()`` only. Kernels are compiled before it starts
(:func:`warm_up`), and that time is reported by itself. Every integrator is driven in the same way; methods that
Mitsuba's own integrators lack are looked up by name: `train`, `train_seconds`, `train_first`, `train_fraction`,
`prepare`, `plan_samples`, `place_samples`, `statistics`, `reset`, `reseed`.

Ctrl-C ends a rendering early and keeps what has been rendered; the result says so. During training it ends the
training, and one pass is rendered with what has been learned.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from mi_neural.image.moments import Accumulator, ErrorEstimate, Groups

from .load import split_channels

#: Called with (done, total), in samples, frames or seconds.
Progress = Callable[[float, float], None]

#: Samples a pixel that one pass under a time budget may have. Few and fixed, so that each can be compiled beforehand.
PASS_SPP = (1, 4, 16, 64)
#: Longest planned pass in seconds; a Ctrl-C may have to wait for so long. Longer passes pay Mitsuba's cost per call
#: less often.
PASS_SECONDS = 1.0
#: Most samples in one pass. 2^21 paths need less than 1 GiB in every scene measured.
PASS_SAMPLES = 2**21
#: Seconds after which an unfinished image is handed to `keep`, so that a killed process leaves it.
KEEP_SECONDS = 60.0

# Streams of random numbers that share nothing: warm-up, image, guides of the denoiser, reference
STREAM_WARM_UP, STREAM_IMAGE, STREAM_GUIDES, STREAM_REFERENCE = range(4)


@dataclass
class Rendered:
    """One image and what it cost.

    rgb              float32, shape (height, width, 3), linear, the sample-weighted mean of all passes
    channels         what else the integrator shows, by name, each of shape (height, width)
    spp              samples a pixel actually taken
    nonfinite        pixels of single passes that were left out because they held a NaN or an infinity
    seconds_train    wall time in training, also in training that happens inside of the first render call
    seconds_render   wall time in rendering without it
    statistics       what the integrator's `statistics` returns, {} for Mitsuba's own
    interrupted      whether it ended early: by Ctrl-C, or for the reason that `problem` gives in one line
    """

    rgb: np.ndarray
    channels: dict[str, np.ndarray]
    spp: int
    nonfinite: int
    seconds_train: float
    seconds_render: float
    statistics: dict[str, float] = field(default_factory=dict)
    interrupted: bool = False
    problem: str = ""


# ------------------------------------------------------------------------------------------------------------------
# One pass


def pass_seed(seed: int, stream: int, index: int) -> int:
    """A 32-bit seed for one pass. Hashed, so that runs with neighbouring seeds have no pass in common."""
    return int(np.random.SeedSequence((seed, stream, index)).generate_state(1)[0])


def clock() -> float:
    """Seconds, after all work that was given to Dr.Jit is done."""
    import drjit as dr

    dr.sync_thread()
    return time.perf_counter()


def render_pass(scene, integrator, spp: int, seed: int, sensor: int = 0) -> np.ndarray:
    """One developed film as an array of shape (height, width, channels).

    It does what ``mi.render`` does without gradients. That function turns every exception into a ``RuntimeError`` of
    its own, also Ctrl-C and an integrator's message to the user.
    """
    import drjit as dr

    camera = scene.sensors()[sensor]
    with dr.suspend_grad():
        image = integrator.render(scene=scene, sensor=camera, seed=seed, spp=spp, develop=True, evaluate=False)
        result = np.array(image)
        camera.sampler().seed(0, 1)  # or the sampler's state keeps the loop of this pass alive
    return result


@contextmanager
def placed(integrator, sequence: int, first: int):
    """Inside, an integrator that can (`place_samples`) takes its stratified random numbers from those of the seed
    `sequence`, from sample number `first` on: so the passes of an image go on where the one before ended."""
    place = getattr(integrator, "place_samples", lambda *_: None)
    place(sequence, first)
    try:
        yield
    finally:
        place(None)


def statistics(integrator) -> dict[str, float]:
    """What the integrator counts about itself; empty for one that counts nothing."""
    return dict(integrator.statistics()) if hasattr(integrator, "statistics") else {}


def reset(integrator, seed: int | None = None) -> None:
    """Forget what was learned, where there is something to forget; with a `seed` learn by other random numbers."""
    if seed is not None and hasattr(integrator, "reseed"):
        integrator.reseed(seed)
    elif hasattr(integrator, "reset"):
        integrator.reset()


def pixels(scene, sensor: int = 0) -> int:
    """Pixels of the film that are rendered."""
    width, height = scene.sensors()[sensor].film().crop_size()
    return int(width) * int(height)


def pass_sizes(scene, sensor: int = 0) -> list[int]:
    """The entries of PASS_SPP whose passes hold at most PASS_SAMPLES samples; 1 always."""
    n = pixels(scene, sensor)
    return [spp for spp in PASS_SPP if spp == 1 or spp * n <= PASS_SAMPLES]


def warm_up(scene, integrator, spps: list[int], seed: int = 0, sensor: int = 0) -> float:
    """Compile every kernel that rendering with these samples a pixel needs; returns the seconds it took.

    An integrator with `prepare` does it without a change of its state; for others one image is rendered and thrown
    away. Raises ``ValueError`` for a film that does not fit memory.
    """
    from mi_neural.integrators.checks import check_film  # of the variant that is set now

    check_film(scene.sensors()[sensor], "the image")
    start = clock()
    for index, spp in enumerate(spps):
        if hasattr(integrator, "prepare"):
            integrator.prepare(scene, sensor=sensor, spp=spp)
        else:
            render_pass(scene, integrator, spp, pass_seed(seed, STREAM_WARM_UP, index), sensor)
    return clock() - start


# ------------------------------------------------------------------------------------------------------------------
# Many passes


def train(scene, integrator, frames: int, sensor: int = 0, progress: Progress | None = None) -> tuple[float, bool]:
    """Train that many frames; returns (seconds, interrupted). Does nothing for an integrator without a cache."""
    if frames <= 0 or not hasattr(integrator, "train"):
        return 0.0, False
    start, interrupted = clock(), False
    try:
        integrator.train(scene, frames, sensor=sensor, progress=progress)
    except KeyboardInterrupt:
        interrupted = True
    return clock() - start, interrupted


def train_first(scene, integrator, sensor: int = 0, progress: Progress | None = None) -> tuple[float, bool]:
    """Train as the first image would; returns (seconds, interrupted). Nothing for an integrator without a cache."""
    if not hasattr(integrator, "train_first"):
        return 0.0, False
    start, interrupted = clock(), False
    try:
        integrator.train_first(scene, sensor=sensor, progress=progress)
    except KeyboardInterrupt:
        interrupted = True
    return clock() - start, interrupted


def preview(scene, integrator, seed: int = 0, sensor: int = 0) -> Rendered | None:
    """One sample a pixel with what has been learned so far; the integrator's state does not change. None for one that
    learns nothing or whose images grow from call to call."""
    if not hasattr(integrator, "previewing") or getattr(integrator, "cumulative", False):
        return None
    run = _Run(scene, integrator, seed, sensor, None)
    with integrator.previewing():
        run.one_pass(1)
    return replace(run.result(), interrupted=True)


def render_samples(
    scene, integrator, spp: int, seed: int = 0, sensor: int = 0, progress: Progress | None = None,
    keep: Callable[[Rendered], None] | None = None,
) -> Rendered:  # fmt: skip
    """Render `spp` samples a pixel. The division into passes depends on film and `spp` alone, and so does the image.

    `keep` is called every KEEP_SECONDS with the image so far, marked as interrupted.
    """
    passes = plan_passes(scene, spp, sensor)
    return render_passes(scene, integrator, passes, spp, seed=seed, sensor=sensor, progress=progress, keep=keep)


def render_passes(
    scene,
    integrator,
    passes: list[int],
    spp: int,
    *,
    first: int = 0,
    seed: int = 0,
    sensor: int = 0,
    progress: Progress | None = None,
    keep: Callable[[Rendered], None] | None = None,
    film: Accumulator | None = None,
) -> Rendered:
    """Render passes of so many samples a pixel each, those with the numbers from `first` on of an image of `spp`.

    A pass's random numbers follow from `seed` and its number, so that parts of an image share none. `film`: where the
    passes go, if something else is wanted of them than their mean.
    """
    run = _Run(scene, integrator, seed, sensor, keep, first, film)
    try:
        run.plan(spp)
        for n in passes:
            run.one_pass(n)
            if progress:
                progress(run.film.spp, sum(passes))
    except KeyboardInterrupt:
        run.interrupted = True
    finally:
        run.plan(None)
    return run.result()


def plan_passes(scene, spp: int, sensor: int = 0) -> list[int]:
    """Samples a pixel of each pass of :func:`render_samples`: equal powers of two and a rest."""
    size = 1
    while size * 2 <= spp and size * 2 * pixels(scene, sensor) <= PASS_SAMPLES:
        size *= 2
    return [size] * (spp // size) + ([spp % size] if spp % size else [])


def render_seconds(
    scene,
    integrator,
    seconds: float,
    seed: int = 0,
    sensor: int = 0,
    progress: Progress | None = None,
    pretrained: bool = False,
    pass_times: dict[int, float] | None = None,
    keep: Callable[[Rendered], None] | None = None,
    watch: Callable[[Rendered], None] | None = None,
) -> Rendered:
    """Render as many samples as fit into `seconds` of wall time, kernels being compiled (:func:`warm_up`).

    An integrator with `train_fraction` first trains for that share of the time, unless it is `pretrained`. Passes then
    have 1, 4, 16 or 64 samples a pixel: the largest that is expected to end in time, by the times of earlier passes.
    The last pass may end up to half of a 1-sample pass late. At least one pass is rendered, however small the budget.

    `pass_times` (samples a pixel -> seconds) is read and updated: hand the same to every frame of a sequence.
    `keep` is called every KEEP_SECONDS with the image so far, marked as interrupted; `watch` after 1, 2, 4, ... samples
    a pixel, while the clock stands still.
    """
    start = clock()
    run = _Run(scene, integrator, seed, sensor, keep)
    watch_at = 1
    times = {} if pass_times is None else pass_times
    sizes = pass_sizes(scene, sensor)
    try:
        fraction = (
            0.0 if pretrained or not hasattr(integrator, "train_fraction") else integrator.train_fraction(seconds)
        )
        if fraction > 0.0:
            run.train_seconds(fraction * seconds)
        while True:
            elapsed = clock() - start
            if progress:
                progress(min(elapsed, seconds), seconds)
            size = choose_pass(sizes, times, seconds - elapsed)
            if size is None and run.film.spp:
                break
            size = size or sizes[0]
            # Samples that the finished image will have, as far as is known
            known = max(times, default=size)
            expected = round((seconds - elapsed) / times[known] * known) if times else size
            run.plan(run.film.spp + max(size, expected))
            times[size] = run.one_pass(size)
            if watch and run.film.spp >= watch_at:
                paused = clock()
                watch(run.result())
                watch_at = 2 * run.film.spp
                start += clock() - paused
    except KeyboardInterrupt:
        run.interrupted = True
        if run.film.spp == 0:
            run.one_pass(sizes[0])
    finally:
        run.plan(None)
    return run.result()


def render_until(
    scene, integrator, error: float, seconds: float | None = None, seed: int = 0, sensor: int = 0,
    progress: Progress | None = None, keep: Callable[[Rendered], None] | None = None, trained: float | None = 0.0,
) -> tuple[Rendered, ErrorEstimate | None]:  # fmt: skip
    """Render until the estimated trimmed relMSE is at most `error`, or for `seconds` if that comes first. Returns the
    image and the estimate: its noise (:class:`~mi_neural.image.moments.Groups`), and the squared bias of a cache that
    says it (`expected_bias`).

    An integrator that measures the noise of tracing (`noise_of_pairs`) plans an image of so many samples that tracing
    alone would have this error. Otherwise it could accept a bias that the estimate does not contain.

    The error is estimated again after nine tenths of the samples that seem to be missing, at most as many as there are
    already. Then an integrator with `train_fraction` trains on until training has had that share of the time that the
    image seems to take, or four times as many samples as there are; `trained`: seconds that it had before, None: it
    does not train.
    """
    start, film, estimate, needed = clock(), Groups(), None, 4.0
    expected_bias, bias = getattr(integrator, "expected_bias", lambda _: 0.0), 0.0  # the latter: mean of the samples
    run = _Run(scene, integrator, seed, sensor, keep, 0, film)
    sizes = pass_sizes(scene, sensor)
    try:
        while estimate is None or estimate.value > error:
            traced = statistics(integrator).get("noise_of_pairs", 0.0) / error
            planned = max(round(needed), round(traced), film.spp + 1)
            run.plan(planned)
            of_pass = expected_bias(planned) ** 0.5
            look, late = film.spp + max(1, min(film.spp, round(0.9 * (needed - film.spp)))), False
            while film.spp < look and not late:
                n = max(s for s in sizes if s == 1 or s <= look - film.spp)
                run.one_pass(n)
                bias += (of_pass - bias) * n / film.spp
                late = seconds is not None and clock() - start >= seconds
            if (noise := film.error()) is not None:
                needed = film.spp * noise.value / (error - min(bias**2, 0.5 * error))
                estimate = noise.with_bias(bias**2)
                if progress:
                    progress(min(film.spp, needed), needed)
            if late:
                break
            if estimate is not None and estimate.value > error and trained is not None:
                whole = run.seconds_render * min(needed / film.spp, 4.0)
                run.train_on(whole, trained, math.inf if seconds is None else seconds - (clock() - start))
    except KeyboardInterrupt:
        run.interrupted = True
    finally:
        run.plan(None)
    return run.result(), estimate


def choose_pass(sizes: list[int], times: dict[int, float], remaining: float) -> int | None:
    """The largest pass that should end within `remaining` seconds, the smallest if half of it fits, else None.

    A size not yet timed is expected to cost as much a sample as the nearest one that was timed, which errs on the long
    side for larger passes.
    """
    if not times:
        return sizes[0] if remaining > 0.0 else None

    def expected(size: int) -> float:
        known = min(times, key=lambda other: abs(np.log(other / size)))
        return times[known] * size / known

    fitting = [size for size in sizes if expected(size) <= min(remaining, PASS_SECONDS)]
    if fitting:
        return max(fitting)
    return sizes[0] if 0.5 * expected(sizes[0]) <= remaining else None


class _Run:
    """The state of one rendering: film, clocks, number of passes."""

    def __init__(
        self, scene, integrator, seed: int, sensor: int, keep: Callable[[Rendered], None] | None,
        first: int = 0, film: Accumulator | None = None,
    ) -> None:  # fmt: skip
        self.keep, self.kept = keep, clock()
        self.scene, self.integrator, self.seed, self.sensor = scene, integrator, seed, sensor
        self.film = Accumulator() if film is None else film
        self.first = self.n_passes = first
        self.seconds_train = self.seconds_render = 0.0
        self.interrupted = False

    def plan(self, spp: int | None) -> None:
        """Tell an integrator that can use it (`plan_samples`) how many samples a pixel the image will have."""
        if hasattr(self.integrator, "plan_samples"):
            self.integrator.plan_samples(spp)

    def train_seconds(self, seconds: float) -> None:
        start = clock()
        try:
            self.integrator.train_seconds(self.scene, seconds, sensor=self.sensor)
        finally:
            self.seconds_train += clock() - start

    def train_on(self, rendering: float, trained: float, left: float) -> None:
        """Train until training has had its share (`train_fraction`) beside so many seconds of `rendering`, those
        included that it has had before the run (`trained`). It takes the seconds that are `left` at most, and a small
        rest is not worth a call."""
        if hasattr(self.integrator, "train_fraction"):
            share = self.integrator.train_fraction(rendering)
            missing = rendering * share / (1 - share) - trained - self.seconds_train
            if missing > 0.1 * rendering and left > 0:
                self.train_seconds(min(missing, left))

    def one_pass(self, spp: int) -> float:
        """Render and accumulate one pass; returns its seconds without such training as happened inside."""
        trained_before = statistics(self.integrator).get("seconds_train", 0.0)
        start = clock()
        seed = pass_seed(self.seed, STREAM_IMAGE, self.n_passes)
        take = self.film.replace if getattr(self.integrator, "cumulative", False) else self.film.add
        number, taken = self.film.sequence() or (self.n_passes - self.first, 0)
        with placed(self.integrator, pass_seed(self.seed, STREAM_IMAGE, self.first + number), taken):
            take(render_pass(self.scene, self.integrator, spp, seed, self.sensor), spp)
        self.n_passes += 1
        seconds = clock() - start
        trained = min(max(0.0, statistics(self.integrator).get("seconds_train", 0.0) - trained_before), seconds)
        self.seconds_train += trained
        self.seconds_render += seconds - trained
        if self.keep is not None and clock() - self.kept > KEEP_SECONDS:
            self.keep(replace(self.result(), interrupted=True))
            self.kept = clock()
        return seconds - trained

    def result(self) -> Rendered:
        if self.film.spp == 0:
            raise KeyboardInterrupt("interrupted before the first samples were there")
        names = self.integrator.aov_names() if hasattr(self.integrator, "aov_names") else []
        rgb, channels = split_channels(self.film.mean(), list(names))
        return Rendered(
            rgb=rgb.astype(np.float32),
            channels={name: values.astype(np.float32) for name, values in channels.items()},
            spp=self.film.spp,
            nonfinite=self.film.nonfinite,
            seconds_train=self.seconds_train,
            seconds_render=self.seconds_render,
            statistics=statistics(self.integrator),
            interrupted=self.interrupted,
        )
