"""Where a kernel ends and the next one begins, on a GPU.

Dr.Jit puts all that has been written since the last evaluation into one kernel. OptiX compiles a large kernel several
times longer than its parts, and on a GPU the parts run faster, needing fewer registers. LLVM gains nothing from it, and
the values on their way through memory cost it 5 % (manual, speed).
"""

from __future__ import annotations

import time

import drjit as dr
import mitsuba as mi


def on_gpu() -> bool:
    """Whether the variant's arrays live on a GPU."""
    return dr.backend_v(mi.Float) == dr.JitBackend.CUDA


def end_kernel(*values) -> None:
    """On a GPU, evaluate `values` (arrays and PyTrees): what is computed from them afterwards is another kernel's.

    `values` must be all that is needed later; the rest would be computed twice. Nothing happens in the body of a
    symbolic loop or call.
    """
    if on_gpu() and not dr.flag(dr.JitFlag.SymbolicScope):
        dr.eval(*values)


def work_seconds() -> float:
    """Seconds to compare work by, after all of it is done: those of the processors where they do it, so that other
    programs count less; on a GPU those of the clock."""
    dr.sync_thread()
    return time.perf_counter() if on_gpu() else time.process_time()
