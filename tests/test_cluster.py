"""Beyond one machine: images put together from parts, on a real cluster of two worker processes, one of them killed.

The workers compile their kernels as the tests do (`quick_kernels` as Dask's preload). Skips where Dask is missing.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from mi_neural.bench import benchmark, budget, changes, cluster, jobs, load, sequence
from mi_neural.bench.load import InputError
from mi_neural.bench.specs import parse_integrator
from mi_neural.bench.workers import ClusterError, Workers, connect
from mi_neural.cli import app
from mi_neural.image import exr
from mi_neural.image.moments import Moments

distributed = pytest.importorskip("distributed", reason="no Dask: pip install 'mi_neural[cluster]'")

HOST = "127.0.0.1"
SIZE, SPP = (16, 16), 64
#: False alarms per statistical test.
ERROR_RATE = 1e-4
NIRC = "nirc:levels=2,hashmap_size=512,width=16,train_samples=256,train_frames=4,train_steps=0"


class Local:
    """A scheduler, and workers of one thread each with a nanny each that starts it anew, as processes of their own."""

    def __init__(self, folder: Path, workers: int = 2) -> None:
        self.folder, self.processes = folder, {}
        try:
            self.start("scheduler", "--port", 0, "--scheduler-file", folder / "scheduler.json")
            self.address = self.wait_for_address(folder / "scheduler.json")
            preload = Path(__file__).with_name("quick_kernels.py")
            self.start("worker", self.address, "--nworkers", workers, "--nthreads", 1, "--preload", preload)
            with distributed.Client(self.address, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=60)
        except BaseException:
            self.end()
            raise

    @staticmethod
    def wait_for_address(file: Path) -> str:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            try:
                return json.loads(file.read_text())["address"]
            except (OSError, ValueError):  # not there, or not all of it
                time.sleep(0.05)
        raise TimeoutError("the scheduler does not start")

    def start(self, kind: str, *arguments) -> None:
        module = f"distributed.cli.dask_{kind}"
        command = [sys.executable, "-m", module, *map(str, arguments), "--host", HOST, "--no-dashboard"]
        with open(self.folder / f"{kind}.log", "w") as log:
            self.processes[kind] = subprocess.Popen(command, cwd=self.folder, stdout=log, stderr=log)

    def end(self) -> None:
        for process in reversed(self.processes.values()):
            process.terminate()
            try:
                process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The address of a cluster with two workers."""
    local = Local(tmp_path_factory.mktemp("cluster"))
    yield local.address
    local.end()


def pids(address: str) -> dict[str, int]:
    """Process of each worker."""
    with distributed.Client(address, set_as_default=False) as client:
        return client.run(os.getpid)


def render(integrator: str = "path", client: str | None = None, spp: int = SPP, **options) -> budget.Rendered:
    return cluster.render("cornell_box", integrator, spp, size=SIZE, client=client, **options)


def variance(rendered: budget.Rendered) -> np.ndarray:
    return np.stack([rendered.channels[f"variance.{c}"] for c in "RGB"], axis=-1)


# ---------------------------------------------------------------- mean and variance of parts


def passes(rng, sizes, n: int = 1) -> list[np.ndarray]:
    """A pass of each size: n x 1 pixels of mean 2, of variance 1 a sample."""
    return [2.0 + rng.standard_normal((n, 1, 1)) / np.sqrt(size) for size in sizes]


def merged(images, sizes, edges=()) -> Moments:
    """The passes, in parts that end before the numbers `edges`."""
    whole = Moments()
    for part in np.split(np.arange(len(sizes)), edges):
        moments = Moments()
        for k in part:
            moments.add(images[k], sizes[k])
        whole.merge(moments)
    return whole


def test_passes_of_one_size_have_the_textbook_variance(rng):
    sizes = [4] * 10
    images = passes(rng, sizes, 50)
    moments = merged(images, sizes)
    np.testing.assert_allclose(moments.mean(), np.mean(images, axis=0), rtol=1e-6)
    np.testing.assert_allclose(moments.variance(), np.var(images, axis=0, ddof=1) / 10, rtol=1e-5)
    assert moments.spp == 40


def test_mean_and_variance_do_not_depend_on_the_parts(rng):
    sizes = [4, 4, 4, 4, 1, 2]
    images = passes(rng, sizes, 20)
    images[3][5] = np.nan
    whole = merged(images, sizes)
    for edges in [(1,), (3, 5), (1, 2, 3, 4, 5), (0, 6)]:
        parts = merged(images, sizes, edges)
        np.testing.assert_allclose(parts.mean(), whole.mean(), rtol=1e-6)
        np.testing.assert_allclose(parts.variance(), whole.variance(), rtol=1e-5)
        assert (parts.spp, parts.nonfinite) == (19, 1)
    without = merged([i[5:6] for k, i in enumerate(images) if k != 3], [4, 4, 4, 1, 2])
    np.testing.assert_allclose(whole.variance()[5], without.variance()[0], rtol=1e-5)


def test_variance_is_right_on_average_for_passes_of_any_size(rng):
    """Means of both are compared with the truth over many pixels; error rate as above, each."""
    sizes = [8, 8, 1, 2, 8]
    n, total = 20_000, sum(sizes)
    moments = merged(passes(rng, sizes, n), sizes, (2,))
    found = moments.variance().astype(np.float64).ravel()
    bound = stats.norm.isf(ERROR_RATE / 2)
    print(f"variance {found.mean():.5f}, true {1 / total:.5f}")
    assert abs(found.mean() - 1 / total) <= bound * found.std(ddof=1) / np.sqrt(n)
    assert abs(moments.mean().astype(np.float64).mean() - 2.0) <= bound / np.sqrt(total * n)


def test_one_pass_says_nothing_about_its_variance(rng):
    assert merged(passes(rng, [4]), [4]).variance() is None
    images = passes(rng, [4, 4], 2)
    images[1][1] = np.inf
    assert np.isinf(merged(images, [4, 4]).variance()[1]) and np.isfinite(merged(images, [4, 4]).mean()).all()


# ---------------------------------------------------------------- how an image is divided


def setup_of(integrator: str = "path") -> tuple[jobs.Setup, load.LoadedScene, benchmark.Case]:
    loaded = load.load_scene("cornell_box", SIZE)
    case = benchmark.make_cases(loaded, [parse_integrator(integrator)])[0]
    return jobs.Setup.of(loaded, case, SIZE), loaded, case


def test_integrator_that_was_frozen_for_parts_is_not_the_one_that_is_measured():
    setup, _, _ = setup_of(NIRC)
    workbench = jobs.Workbench()
    loaded, case = workbench.ready(setup)
    workbench.learned(None)
    assert case.integrator.freeze_cache and workbench.ready(setup)[1] is case
    again, fresh = workbench.ready(setup, fresh=True)
    assert again is loaded and not fresh.integrator.freeze_cache
    other = replace(setup, keys=setup.keys | {"cache_samples": 1})
    assert workbench.ready(other)[0] is loaded and workbench.ready(replace(setup, size=(8, 8)))[0] is not loaded


@pytest.mark.parametrize("spp", [1, 5, 64, 100])
def test_parts_hold_every_pass_once_whatever_their_number(spp):
    setup, loaded, _ = setup_of()
    planned = cluster.plan_passes(loaded.scene, spp)
    assert sum(planned) == spp and len(planned) >= min(spp, cluster.LEAST_PASSES)
    for n in (1, 3, 16, 1000):
        parts = cluster.plan_parts(setup, planned, n, 0)
        assert [p.first for p in parts] == list(np.cumsum([0, *(len(p.passes) for p in parts)])[:-1])
        assert [size for p in parts for size in p.passes] == planned
        assert len(parts) == min(n, len(planned)) and all(p.spp == spp for p in parts)


def test_passes_are_those_of_one_process_where_it_has_many(monkeypatch):
    monkeypatch.setattr(budget, "PASS_SAMPLES", 4 * SIZE[0] * SIZE[1])
    scene = load.load_scene("cornell_box", SIZE).scene
    assert cluster.plan_passes(scene, 66) == budget.plan_passes(scene, 66) == [4] * 16 + [2]


# ---------------------------------------------------------------- two workers


@pytest.mark.parametrize("n", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_image_of_two_workers_is_that_of_one_process_although_some_are_killed(address, n):
    """The same passes with the same numbers: equal up to the order of summation."""
    before, victims = pids(address), []

    def kill(done: float, total: float) -> None:
        if not victims:
            victims.extend(list(before.values())[:n])
            for pid in victims:
                os.kill(pid, signal.SIGKILL)

    found, known = render(client=address, progress=kill), render()
    assert len(victims) == n and found.spp == SPP and not found.interrupted
    np.testing.assert_allclose(found.rgb, known.rgb, rtol=1e-5)
    np.testing.assert_allclose(variance(found), variance(known), rtol=1e-4)

    deadline = time.monotonic() + 30
    while len(after := pids(address)) < 2 and time.monotonic() < deadline:
        time.sleep(0.2)
    assert len(after) == 2 and not set(victims) & set(after.values()), "their nannies start them anew"


def test_merged_image_and_another_of_one_process_differ_by_their_variances(address):
    """Other random numbers: differences over their standard errors have mean square 1, pixel by pixel.

    256 pixels, whose squares have a standard deviation of about 1.6: four of its errors on each side are 1 in 10,000.
    """
    a, b = render(client=address, seed=1), render(seed=2)
    z = (a.rgb - b.rgb)[..., 1] / np.sqrt(variance(a) + variance(b))[..., 1]
    print(f"mean of z {z.mean():.3f}, of its square {np.mean(z**2):.3f}")
    assert abs(z.mean()) < stats.norm.isf(ERROR_RATE / 2) / np.sqrt(z.size)
    assert abs(np.mean(z**2) - 1.0) < 4.0 * 1.6 / np.sqrt(z.size)


def test_cache_is_trained_once_and_read_by_the_workers(address, tmp_path):
    _, loaded, case = setup_of(NIRC)
    case.integrator.train_first(loaded.scene)
    file = tmp_path / "cache.npz"
    case.integrator.save_cache(file)
    found, known = render(NIRC, address, cache=file), render(NIRC, cache=file)
    np.testing.assert_allclose(found.rgb, known.rgb, rtol=1e-3, atol=1e-4)
    assert found.statistics["queries"] == known.statistics["queries"] > 0


def test_ctrl_c_keeps_the_parts_that_are_done(address):
    def stop(done: float, total: float) -> None:
        raise KeyboardInterrupt

    found = render(client=address, progress=stop)
    assert found.interrupted and 0 < found.spp < SPP and found.rgb.mean() > 0.1
    assert not render(client=address).interrupted, "and the workers take what comes next"


def test_command_renders_on_the_workers_and_keeps_the_variance(address, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["render", "cornell_box", "-i", "path", "--spp", str(SPP), "--size", "16x16", "--json", "a.json"]
    done = CliRunner().invoke(app, [*command, "-o", "a.exr", "--scheduler", address.removeprefix("tcp://")])
    assert done.exit_code == 0, done.output
    image, known = exr.read("a.exr"), render()
    np.testing.assert_allclose(image.rgb, known.rgb, rtol=1e-5)
    np.testing.assert_allclose(image.layer("variance"), variance(known), rtol=1e-4)
    assert json.loads(Path("a.json").read_text())["statistics"]["workers"] == 2


@pytest.mark.parametrize("integrator", ["path", NIRC])
def test_frames_of_two_workers_are_those_of_one_process(address, tmp_path, integrator):
    """A lamp that dims from frame to frame, and a cache that is trained before the first one only."""
    texts = ["emitter.radiance.value=value*(1-0.2*frame)"]
    plan = sequence.Plan(spp=4, seed=3)

    def run(folder: Path, client: str | None) -> list[np.ndarray]:
        loaded = load.load_scene("cornell_box", SIZE, merge=False)
        case = benchmark.make_cases(loaded, [parse_integrator(integrator)])[0]
        over_time = sequence.Sequence(loaded.scene, changes.parse(texts, 4, None), 4)
        with connect(client) as workers:
            elsewhere = workers and cluster.frames_of(workers, loaded, SIZE, texts, over_time, plan)
            [result] = sequence.Run(loaded, over_time, plan, folder, elsewhere=elsewhere).run([case])
        return [result.image(k).rgb for k in range(4)]

    found, known = run(tmp_path / "cluster", address), run(tmp_path / "here", None)
    means = [image.mean() for image in known]
    assert means == sorted(means, reverse=True) and means[-1] < 0.8 * means[0]
    # Two trainings differ by the order in which records are summed
    np.testing.assert_allclose(found, known, rtol=1e-5 if integrator == "path" else 0.05, atol=1e-3)


def test_cases_are_measured_by_the_workers(address, tmp_path, monkeypatch):
    """All integrators of all scenes, both repeats; each row says where."""
    monkeypatch.chdir(tmp_path)
    command = ["compare", "cornell_box", "lit_cube", "-i", "path", "-i", "direct", "--seconds", "0.1", "--repeats",
               "2", "--size", "16x16", "--reference-spp", "32", "--reference-cache", "kept", "-o", "out"]  # fmt: skip
    done = CliRunner().invoke(app, [*command, "--scheduler", address])
    assert done.exit_code == 0, done.output
    assert "4 cases on 2 workers" in done.output
    rows = [row for row in json.loads(Path("out/results.json").read_text())["rows"] if row["mode"] == "one-shot"]
    found = {(row["scene"], row["label"], row["repeat"]) for row in rows}
    assert len(found) == len(rows) == 8 and {row["scene"] for row in rows} == {"cornell_box", "lit_cube"}
    assert len({row["environment"]["worker"] for row in rows}) == 2
    assert all(row["environment"]["threads"] == 1 and row["relmse"] >= 0.0 and row["spp"] >= 1 for row in rows)
    assert "</html>" in Path("out/report.html").read_text()


# ---------------------------------------------------------------- what goes wrong is one line


@dataclass
class Homeless:
    """A job whose class the workers cannot import."""

    def run(self):
        return 1


def first_error(address: str, job) -> str:
    with connect(address) as workers, pytest.raises(ClusterError) as error:
        next(workers.run([(job, None)]))
    assert "\n" not in str(error.value)
    return str(error.value)


def test_error_of_a_worker_comes_back_as_one_line_that_names_it(address):
    [part] = cluster.plan_parts(setup_of()[0], [1], 1, 0)
    text = first_error(address, replace(part, setup=replace(part.setup, scene="/nowhere/scene.xml")))
    assert text.startswith("worker tcp://") and "it sees no file /nowhere/scene.xml" in text
    assert "a worker cannot import test_cluster" in first_error(address, Homeless())


WRONG = {
    "versions": ({"versions": jobs.versions() | {"mitsuba": "1.0"}}, "it has mitsuba 3.* sent the job has 1.0: "),
    "scene": ({"scene": "/nowhere/a.xml"}, "it sees no file /nowhere/a.xml: put scene, meshes and textures where all"),
    "digest": ({"digest": "0"}, r"its .*cornell_box.xml, or a file that it names, is not the one here"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_process_that_would_give_another_result_refuses(kind):
    changed, message = WRONG[kind]
    with pytest.raises(InputError, match=message):
        jobs.Part(replace(setup_of()[0], **changed), 0, (1,), 1, 0).run()


@pytest.mark.parametrize(
    "integrator, over_time, message",
    [
        ("restir_di", False, "reuses the images before .*: add history=0"),
        ("nirc_two_level:mode=progressive", False, "mode=progressive"),
        ("nirc", True, "trains before each frame .*: add train_steps=0"),
    ],
)
def test_what_cannot_be_rendered_in_parts_is_refused(integrator, over_time, message):
    with pytest.raises(ClusterError, match=message):
        cluster.check(setup_of(integrator)[2], over_time)


@pytest.mark.parametrize("wrong", ["tcp://127.0.0.1:1", "nonsense", "no://127.0.0.1:1"])
def test_address_where_no_scheduler_answers(wrong, monkeypatch):
    monkeypatch.setattr("mi_neural.bench.workers.CONNECT_SECONDS", 0.5)
    with pytest.raises(ClusterError, match=r"no Dask scheduler answers at .*: type `dask scheduler`"):
        render(client=wrong)


def test_dask_that_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"pip install 'mi_neural\[cluster\]'"):
        render(client="tcp://127.0.0.1:1")
    assert render(spp=4).spp == 4, "needed for nothing else"


def test_no_worker_for_a_while():

    class Nobody:
        status, scheduler = "running", type("", (), {"address": "tcp://HOST:8786"})

        def nthreads(self):
            return {}

    workers = Workers(Nobody(), patience=0.1)
    for wait in (workers.count, lambda: next(workers.map([(None, None)]))):
        with pytest.raises(ClusterError, match=r"no worker at tcp://HOST:8786 for 0.1 s: start one with"):
            wait()


@pytest.mark.parametrize("alive", [True, False])
def test_answer_of_a_worker_that_died_is_not_waited_for(alive):
    """One that lives may take long to send it."""

    class Slow:
        calls = 0

        def done(self):
            return True

        def result(self, timeout):
            self.calls += 1
            if self.calls == 3:
                return "answer"
            raise distributed.TimeoutError

    class OneWorker:
        status, scheduler = "running", type("", (), {"address": "tcp://HOST:8786"})

        def nthreads(self):
            return {"tcp://HOST:1": 1} if alive else {"tcp://HOST:2": 1}

    future = Slow()
    found = Workers(OneWorker())._fetch(future, "tcp://HOST:1")
    assert (found, future.calls) == (("answer", 3) if alive else (None, 1))


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["worker", "scheduler"])
def test_lost_cluster_leaves_the_image_of_the_parts_that_are_done(tmp_path, lost):
    local = Local(tmp_path)

    def kill(done: float, total: float) -> None:
        process = local.processes[lost]
        if process.poll() is None:
            process.kill() if lost == "scheduler" else process.terminate()
            process.wait()

    try:
        found = render(client=local.address, progress=kill, patience=2.0)
    finally:
        local.end()
    message = {"worker": "no worker at .* for 2 s: start one with", "scheduler": "does not answer any more"}[lost]
    assert re.search(message, found.problem), found.problem
    assert found.interrupted and 0 < found.spp < SPP and found.rgb.mean() > 0.1


@dataclass(frozen=True)
class Fatal(jobs.Part):
    """A job that ends its worker, as one does that needs more memory than there is."""

    def __reduce__(self):
        return os._exit, (1,)


@pytest.mark.slow
def test_job_that_ends_every_worker_is_given_up(address):
    fatal = Fatal(setup_of()[0], 0, (1,), 1, 0)
    assert "a job lost 4 workers, one after the other" in first_error(address, fatal)
