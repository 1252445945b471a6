"""Peak memory of this process, counted from zero for each integrator that is measured."""

from __future__ import annotations

import gc
from pathlib import Path

_PROCESS = Path("/proc/self")


def start() -> bool:
    """Free the memory that Dr.Jit keeps for later use, and count the peak from here on; False where the system
    cannot."""
    import drjit as dr

    dr.sync_thread()
    gc.collect()
    dr.flush_malloc_cache()
    try:
        (_PROCESS / "clear_refs").write_text("5")  # Linux: resets the high-water mark to what is resident now
    except OSError:
        return False
    return True


def peak_mib() -> float | None:
    """Most memory in MiB that was resident since :func:`start`, the interpreter and the scene included; None where the
    system does not count it. Graphics memory is not part of it."""
    try:
        lines = (_PROCESS / "status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:")), None)
