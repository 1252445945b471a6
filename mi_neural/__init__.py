"""Online-trained neural caches for Mitsuba 3.

Importing this package registers its plugins, now and at every later ``mi.set_variant``; it sets no variant, thread
count or log level of its own. It also provides a working LLVM library, which Dr.Jit chooses while Mitsuba is being
imported: where the system's own is missing, import ``mi_neural`` before ``mitsuba`` (see :mod:`mi_neural.llvm`).
"""

from importlib import import_module as _import_module

from . import llvm

llvm.prepare()  # before Dr.Jit is imported, here or anywhere below

from .llvm import LLVMError  # noqa: E402
from .registration import register, variant_problem  # noqa: E402

__version__ = "0.2.0"

# Public names, and the modules that are imported when they are first used
_LAZY = {
    "Field": "mi_neural.caches.field",
    "denoise": "mi_neural.bench.guides",
    "guides": "mi_neural.bench.guides",
    "live": "mi_neural.explore.live",
}

__all__ = ["Field", "LLVMError", "__version__", "denoise", "guides", "live", "llvm", "register", "variant_problem"]


def __getattr__(name):
    if name not in _LAZY:
        raise AttributeError(f"module 'mi_neural' has no attribute '{name}'")
    value = globals()[name] = getattr(_import_module(_LAZY[name]), name)
    return value


def __dir__():
    return sorted({*globals(), *__all__})


register()
