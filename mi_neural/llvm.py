"""Find an LLVM library that Dr.Jit can work with, before Dr.Jit looks for one itself.

Measured with Mitsuba 3.9.1 and Dr.Jit 1.5.0 on Debian 12, x86-64:

- Dr.Jit chooses its LLVM during ``import drjit``, hence during ``import mitsuba``; ``DRJIT_LIBLLVM_PATH`` is read then
  and never again. ``mi.set_variant`` and the first array come too late.
- Left to itself it takes the newest ``libLLVM`` of the system. LLVM 14 it refuses; with 15 and 16 the first render
  aborts the process ("LLVM ERROR: Cannot select: fminimum"); 17, 18, 19 and 23 work.
- The backend can be shut down and started anew as long as nobody has used it (``jit.h``: "It is possible to
  re-initialize the JIT following a call to jit_shutdown()"), but not where it found no library at all.

So :func:`prepare` runs before anything else in this package. With ``mi_neural`` imported first it always wins; with
``mitsuba`` imported first it replaces an LLVM that is too old, unless a variant has already been set.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import re
import sys
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
DISTRIBUTION = "karellen-llvm-core"

# x86-64 back ends before LLVM 17 cannot select `fminimum`; elsewhere Dr.Jit's own minimum holds.
MIN_VERSION = 17 if platform.machine().lower() in ("x86_64", "amd64") else 15


class LLVMError(ImportError):
    """No LLVM library that Dr.Jit could use; the message ends with what to type."""


def packaged_library() -> Path | None:
    """The ``libLLVM`` in the file list of the installed distribution ``karellen-llvm-core``, or None."""
    try:
        files = importlib.metadata.files(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    names = [f for f in files if re.fullmatch(r"libLLVM([-.][\w.]*)?\.so(\.[\d.]+)?", f.name)]
    found = {Path(f.locate()).resolve() for f in names}  # links to one and the same file fall together
    return max((p for p in found if p.is_file()), key=lambda p: p.stat().st_size, default=None)


def prepare() -> None:
    """Point Dr.Jit to the packaged LLVM, unless the user chose one or Dr.Jit already runs with a good one.

    Raises :class:`LLVMError` if ``DRJIT_LIBLLVM_PATH`` names a file that does not exist.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen and os.path.dirname(chosen) and not os.path.exists(chosen):  # a bare name is looked up by the loader
        raise LLVMError(f"{VARIABLE} is set to '{chosen}', which does not exist. Type: unset {VARIABLE}")
    library = packaged_library()
    if chosen or library is None:
        return
    if "drjit" not in sys.modules:
        os.environ[VARIABLE] = str(library)
    elif version() is not None and too_old() and _unused():
        _restart(library)


def version() -> tuple[int, int, int] | None:
    """The version of the LLVM that Dr.Jit has loaded, None if it found none."""
    import drjit as dr

    found = dr.detail.llvm_version()
    return None if found is None or found[0] < 0 else tuple(found)


def too_old() -> bool:
    """Whether Dr.Jit has loaded an LLVM that would abort the process or is refused."""
    found = version()
    return found is not None and found[0] < MIN_VERSION


def problem() -> str | None:
    """Why the LLVM backend cannot be used in this process and what to type instead; None if it can."""
    found = version()
    if found is not None and not too_old():
        return None

    library, chosen = packaged_library(), os.environ.get(VARIABLE)
    if found is None:
        what = "Dr.Jit found no LLVM library it can use"
    else:
        what = f"Dr.Jit has loaded LLVM {'.'.join(map(str, found))}"
        what += f" ({path})" if (path := _loaded_path()) else ""
        what += f", with which rendering aborts the process; it takes LLVM {MIN_VERSION} or newer"

    if chosen and chosen != str(library):
        fix = f"{VARIABLE} is set to '{chosen}'. Type: unset {VARIABLE}"
    elif library is not None:
        fix = (
            "Mitsuba was imported before mi_neural, and the library is chosen then. "
            "Write `import mi_neural` above `import mitsuba`, at least above `mi.set_variant(...)`, and start again; "
            f"or type: export {VARIABLE}='{library}'"
        )
    elif sys.platform == "linux" and platform.machine() == "x86_64":
        fix = f"Type: pip install {DISTRIBUTION}"
    elif sys.platform == "darwin":
        fix = f"Type: brew install llvm; if it is still not found: export {VARIABLE}=/path/to/libLLVM.dylib"
    elif sys.platform == "win32":
        fix = f"Install LLVM {MIN_VERSION} or newer from https://releases.llvm.org, then: set {VARIABLE}=LLVM-C.dll"
    else:
        fix = f"Install LLVM {MIN_VERSION} or newer, then type: export {VARIABLE}=/path/to/libLLVM.so"
    return f"{what}. {fix}"


def check(variant: str | None) -> None:
    """Raise :class:`LLVMError` where rendering with ``variant`` would fail or abort for want of a usable LLVM.

    Without a variant, raises only if no backend is left that one could choose.
    """
    import drjit as dr

    if variant is None:
        needed = not dr.has_backend(dr.JitBackend.CUDA)
    else:
        needed = variant.startswith("llvm")
    if needed and (text := problem()):
        raise LLVMError(text)


def describe() -> dict:
    """``path``, ``version`` (text), ``source`` (environment | karellen-llvm-core | system) and ``problem`` of the LLVM
    that Dr.Jit has loaded; all but ``problem`` are None if there is none."""
    found, path = version(), _loaded_path()
    if found is None:
        return dict(path=None, version=None, source=None, problem=problem())
    if path is not None and path == packaged_library():
        source = DISTRIBUTION
    else:
        source = "environment" if os.environ.get(VARIABLE) else "system"
    return dict(path=str(path) if path else None, version=".".join(map(str, found)), source=source, problem=problem())


def _loaded_path() -> Path | None:
    """The libLLVM file mapped into this process: the one that the variable names, else any (Linux; elsewhere the
    variable is believed)."""
    chosen = os.environ.get(VARIABLE)
    try:
        maps = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return Path(chosen) if chosen else None
    mapped = {Path(m[1]) for line in maps if (m := re.search(r"\s(/\S.*libLLVM[^/]*)$", line))}
    if chosen and (path := Path(chosen).resolve()) in mapped:
        return path
    return min(mapped, default=None)


def _unused() -> bool:
    """Whether nothing in this process depends on the running backend yet. Errs on the side of no."""
    import drjit as dr

    return (
        not any(re.match(r"mitsuba\.(llvm|cuda|metal)_", name) for name in sys.modules)
        and "No variables registered" in dr.whos(True)
        and not dr.has_backend(dr.JitBackend.CUDA)
    )


def _restart(library: Path) -> None:
    """Shut Dr.Jit down and start it with ``library``; leaves it as it was where that cannot be done."""
    import drjit as dr

    try:
        core = ctypes.CDLL(str(Path(dr.__file__).parent / "libdrjit-core.so"), mode=os.RTLD_NOLOAD | os.RTLD_NOW)
        shutdown, init = core._Z12jit_shutdowni, core._Z8jit_initj
    except (OSError, AttributeError):
        return
    os.environ[VARIABLE] = str(library)
    shutdown(0)
    init((1 << dr.JitBackend.CUDA.value) | (1 << dr.JitBackend.LLVM.value))
