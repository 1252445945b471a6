"""What all tests share: one variant, fixed seeds, quick kernels, fresh interpreters, the scenes beside the checkout.

The variant is llvm_ad_rgb; `MI_NEURAL_TEST_VARIANT=cuda_ad_rgb python -m pytest` runs the same tests on a GPU.
"""

import functools
import gc
import importlib
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import quick_kernels  # (first: it chooses how kernels are compiled)

import mi_neural  # isort: skip  (second: it chooses the LLVM library)
import mitsuba as mi  # isort: skip
import numpy as np
import pytest

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # As shells start what runs in the background. Mitsuba 3.9.1 passes a SIGINT on to whatever handler was there before
    # its own: with "ignore", an invalid address
    signal.signal(signal.SIGINT, signal.default_int_handler)

VARIANT = os.environ.get("MI_NEURAL_TEST_VARIANT", "llvm_ad_rgb")
ROOT = Path(__file__).resolve().parents[1]

if text := mi_neural.variant_problem(VARIANT):
    raise pytest.UsageError(f"MI_NEURAL_TEST_VARIANT: {text}")
mi.set_variant(VARIANT)  # test modules may use mi.* while they are collected
#: Tests load scenes on one thread: with more, a scene's lights and shapes are numbered in another order each time, and
#: the same seeds choose other lights.
mi.load_dict = functools.partial(mi.load_dict, parallel=False)
mi.load_file = functools.partial(mi.load_file, parallel=False)
#: Begins the code of a fresh interpreter: kernels and threads are as in this process.
QUICK = f"""import sys
sys.path.insert(0, {str(ROOT / 'tests')!r})
import quick_kernels, mitsuba
def set_variant(*names, before=mitsuba.set_variant):
    before(*names)
    quick_kernels.let_others_work()
mitsuba.set_variant = set_variant
"""
gc.disable()  # while test modules are imported: what they define stays
_unfreeze, _released = gc.unfreeze, []


def _unfrozen() -> None:
    """`mi.render`, after a function that a test froze, releases all that was kept."""
    _unfreeze()
    _released.append(True)


gc.unfreeze = _unfrozen


def pytest_collection_finish():
    gc.enable()
    _keep_what_is_there()


def _keep_what_is_there():
    """What is there by now stays: it need not be looked through after every test."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def _kept():
    # Fixtures of earlier modules are gone by now, and what remains are libraries: to look through them takes 30 ms and
    # more after every test
    _keep_what_is_there()
    kept_again = []
    yield kept_again
    if kept_again:
        _unfreeze()  # this module's fixtures were among it


@pytest.fixture(autouse=True)
def _same_start_for_every_test(_kept):
    quick_kernels.let_others_work()  # a test may have started new ones
    mi.set_variant(VARIANT)
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 (for libraries that draw from the global state)
    yield
    mi.set_variant(VARIANT)
    # Scenes and integrators refer to each other in circles. Those of old tests would be compiled into the calls of the
    # next ones, being in Dr.Jit's registry, and be freed at any moment of them.
    gc.collect()
    if _released:  # to look through the libraries, too, would take half a second after each of the module's tests
        gc.freeze()
        _released.clear()
        _kept.append(True)


@pytest.fixture
def variant() -> str:
    """The variant the tests run under."""
    return VARIANT


@pytest.fixture
def full_disk(monkeypatch):
    """Call it with `savez` or `replace`: writing a cache file fails half-way, or when it is put in its place."""

    def fail(first, *_, **__):
        if hasattr(first, "write"):
            first.write(b"half a fi")
        raise OSError("disk full")

    def fill(where: str):
        monkeypatch.setattr(*{"savez": (np, "savez"), "replace": (os, "replace")}[where], fail)

    return fill


@pytest.fixture
def rng() -> np.random.Generator:
    """NumPy's generator with a fixed seed."""
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def root() -> Path:
    """The root of the checkout."""
    return ROOT


@pytest.fixture(scope="module")
def docs_script(root):
    """Imports a script of the folder docs by its name; none stays behind."""
    folder, before = str(root / "docs"), set(sys.modules)
    sys.path.insert(0, folder)
    yield importlib.import_module
    sys.path.remove(folder)
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None) or "").startswith(folder):
            del sys.modules[name]


@pytest.fixture(scope="session")
def shared_scenes() -> Path:
    """The folder of well-known scenes with references beside the checkout; tests skip where it is absent."""
    path = ROOT.parent / "shared" / "scenes"
    if not path.is_dir():
        pytest.skip("no ../shared/scenes beside the checkout: the well-known scenes are not shipped with the package")
    return path


@pytest.fixture
def run_python(tmp_path):
    """`run_python(code, VAR="...")`: code in a fresh interpreter, without our choice of LLVM; `ok=False`: may fail;
    `quick=True`: `mi_neural` is imported first, and kernels are compiled as in this process."""

    def run(code: str, ok: bool = True, quick: bool = False, **env: str) -> subprocess.CompletedProcess:
        if quick:
            code = QUICK + code
        base = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"}
        done = subprocess.run(
            [sys.executable, "-c", code], env=base | env, cwd=tmp_path, capture_output=True, text=True, timeout=300
        )
        assert not ok or done.returncode == 0, f"exit status {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    return run
