"""Kernels of the tests are compiled quickly, and kept where no render finds them. Import this before Mitsuba.

With an empty kernel cache most of a test run is LLVM optimising kernels that run once or twice. Dr.Jit always asks for
the optimised code and has no switch; LLVM itself can leave out every pass that is not needed for correct code, as it
does for ``clang -O0`` (``-opt-bisect-limit=0``, LLVM's means of finding a pass that is wrong). The program that Dr.Jit
hands over is the same, and so is its arithmetic: what is tested here is ours, not LLVM's optimisation of it. Measured:
a kernel is ready in a third of the time, and runs as fast within what the tests notice. Registers are given out
by LLVM's basic allocator: a test of caches in fog, which compiles 124 kernels, took 10.5 s of processor time with the
greedy one and takes 9.4, and one that renders longer than it compiles takes as long. That of ``clang -O0``
(``-optimize-regalloc=0``) compiles faster still (8.7 s), but the images of the other take 5.7 s instead of 4.0.

``MI_NEURAL_TEST_OPTIMIZED=1 python -m pytest`` tests with the kernels that users run, from their cache.

Dr.Jit looks up a kernel by its program, not by how it was compiled, so these have a cache of their own.
"""

import contextlib
import ctypes
import os
from pathlib import Path

TASKS = Path("/proc/self/task")  # the threads of this process
CACHE = Path(__file__).resolve().parents[1] / ".pytest_cache" / "kernels"

optimized = os.environ.get("MI_NEURAL_TEST_OPTIMIZED", "") not in ("", "0")

if not optimized:
    os.environ["DRJIT_CACHE_DIR"] = str(CACHE)  # read when Dr.Jit is imported

import mi_neural  # noqa: E402  (chooses the LLVM library)


def skip_optimisation() -> None:
    """Let LLVM skip all passes that may be skipped, in this process."""
    name = os.environ.get(mi_neural.llvm.VARIABLE)
    if not name:
        return  # Dr.Jit has looked for a library of the system's: compile as it does
    options = [b"", b"-opt-bisect-limit=0", b"-opt-bisect-verbose=0", b"-regalloc=basic"]
    parse = ctypes.CDLL(name).LLVMParseCommandLineOptions  # the library Dr.Jit has loaded: one handle per process
    parse.argtypes, parse.restype = [ctypes.c_int, ctypes.POINTER(ctypes.c_char_p), ctypes.c_char_p], None
    parse(len(options), (ctypes.c_char_p * len(options))(*options), None)


def let_others_work() -> None:
    """A thread of Dr.Jit that waits for work spins for 20 ms. Where each core has a process of pytest-xdist, that was a
    quarter of all time. With the lowest priority they spin, and work, where a core is idle."""
    for task in TASKS.iterdir() if TASKS.is_dir() else ():  # Linux
        with contextlib.suppress(OSError):  # it has ended meanwhile
            if (task / "comm").read_text().startswith("nt ["):
                os.setpriority(os.PRIO_PROCESS, int(task.name), 19)


if not optimized:
    skip_optimisation()
