"""What a measurement was made with: versions, cores, back ends."""

from __future__ import annotations

import os
import platform
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_IMPORTED = time.monotonic()

#: Distributions whose versions belong to a result; the last one is optional.
DISTRIBUTIONS = ("mitsuba", "drjit", "numpy", "OpenEXR", "flip-evaluator", "mitsuba-oidn")


def describe() -> dict[str, object]:
    """Versions, variant, processor, cores and LLVM as a dictionary that JSON can hold. Missing packages are None."""
    import mitsuba as mi

    import mi_neural

    llvm = mi_neural.llvm.describe()
    return {
        "mi_neural": mi_neural.__version__,
        **{name: _version(name) for name in DISTRIBUTIONS},
        "python": platform.python_version(),
        "variant": mi.variant(),
        "cpu": processor(),
        "cores": cores(),
        "threads": _threads(),
        "llvm": llvm.get("version"),
        "llvm_source": llvm.get("source"),
        "system": platform.platform(),
    }


def cores() -> int:
    """Cores this process may run on, which in a container are fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> str:
    """The processor's name as its maker writes it; on other systems than Linux, what Python reports."""
    if sys.platform == "linux":
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def seconds_since_start() -> float:
    """Seconds since this process was started; where the system does not keep that, since this module was imported."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        started = int(fields[19]) / os.sysconf("SC_CLK_TCK")  # field 22: clock ticks after the machine's start
        return time.clock_gettime(time.CLOCK_BOOTTIME) - started
    except (OSError, AttributeError, IndexError, ValueError):
        return time.monotonic() - _IMPORTED


def _threads() -> int:
    """Worker threads that Dr.Jit renders with."""
    import drjit as dr

    return dr.thread_count()


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None
