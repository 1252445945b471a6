"""Make the plugins known to Mitsuba, once per variant, whenever a variant is set.

A plugin class derives from classes of one variant (``mi.SamplingIntegrator`` is another class after each
``mi.set_variant``), so its module is executed once per variant. Each variant keeps its own module objects: what was
made under one variant still works after a visit to another.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import importlib.util
import sys
from types import ModuleType

from . import llvm

# The variants in which the plugins work: RGB, differentiable (training), on a JIT backend.
SUPPORTED = ("llvm_ad_rgb", "cuda_ad_rgb")
# Those in which only what holds no radiance works: the light samplers, and the integrators of `WITHOUT_CACHE`.
OTHER_COLOURS = ("llvm_ad_mono", "llvm_ad_spectral", "cuda_ad_mono", "cuda_ad_spectral")
WITHOUT_CACHE = ("plain_path",)

# (package, variant) -> the modules of that package as executed under that variant
_modules: dict[tuple[str, str], dict[str, ModuleType]] = {}


def variant_problem(variant: str | None = None) -> str | None:
    """Why the plugins cannot run under ``variant`` (default: the current one) and what to type; None if they can."""
    import mitsuba as mi

    variant = variant or mi.variant()
    if variant in SUPPORTED:
        return None
    fix = 'type: mi.set_variant("llvm_ad_rgb") (CPU) or mi.set_variant("cuda_ad_rgb") (NVIDIA)'
    if variant is None:
        return f"no Mitsuba variant is set; {fix}"
    if variant.startswith("scalar"):
        why = "scalar variants have no Dr.Jit arrays, with which it computes"
    elif "polarized" in variant:
        why = "no integrator of it tracks polarization"
    elif variant in OTHER_COLOURS:
        why = f"the caches hold RGB radiance; {', '.join(WITHOUT_CACHE)} with any light sampler works in it"
    elif "spectral" in variant or "mono" in variant:
        why = "the caches hold RGB radiance"
    elif "_ad_" not in variant:
        why = "a cache is trained by automatic differentiation"
    else:
        why = "it is untested"
    return f'mi_neural does not support the variant "{variant}": {why}; {fix}'


def register() -> None:
    """Register the plugins for the current variant, if one is set, and for every variant set from now on."""
    import mitsuba as mi

    mi.detail.remove_variant_callback(_on_variant)  # no effect unless called a second time
    mi.detail.add_variant_callback(_on_variant)
    llvm.check(mi.variant())
    _own_line_last()
    if mi.variant() is not None:
        _register_for(mi.variant())


def _own_line_last() -> None:
    """Let the last line of an error inside of ``mi.render`` be the plugin's own, and nothing be collected where it is
    part of a function that the user freezes: memory freed in a recording ends the process. What is garbage by then is
    left alone until the next image outside of one.

    Mitsuba hands every exception on as the cause of another, "drjit.custom(...): error while performing ...": the line
    that says what to do is added as a note (Python 3.11 and newer).
    """
    import mitsuba.python.util as util

    render = util.render
    if hasattr(render, "own_line_last"):
        return

    from .render.frozen import is_recording, undisturbed

    @functools.wraps(render)
    def wrapped(*args, **keys):
        recording = is_recording()
        if recording:
            gc.freeze()
        elif wrapped.left_alone:
            gc.unfreeze()
        wrapped.left_alone = recording
        try:
            with undisturbed() if recording else contextlib.nullcontext():
                return render(*args, **keys)
        except RuntimeError as e:
            cause = e
            while cause.__cause__ is not None:
                cause = cause.__cause__
            if hasattr(e, "add_note") and cause is not e and str(cause).partition(":")[0] in _names():
                e.add_note(str(cause))
            raise

    wrapped.own_line_last, wrapped.left_alone = True, False
    for module in [m for n, m in sys.modules.items() if n.partition(".")[0] == "mitsuba"]:
        if vars(module).get("render") is render:
            module.render = wrapped


def _names() -> set[str]:
    from . import emitters, integrators

    return {*integrators.PLUGINS, *emitters.PLUGINS}


def plugin_names(package: ModuleType) -> tuple[str, ...]:
    """The entries of ``package.PLUGINS`` whose modules exist."""
    return tuple(n for n in package.PLUGINS if importlib.util.find_spec(f"{package.__name__}.{n}"))


def _on_variant(old: str | None, new: str) -> None:
    llvm.check(new)
    _register_for(new)


def _register_for(variant: str) -> None:
    import mitsuba as mi

    from . import emitters, integrators

    for package, register_plugin in ((emitters, mi.register_emitter), (integrators, mi.register_integrator)):
        names = plugin_names(package)
        text = variant_problem(variant)
        if text is None or variant in OTHER_COLOURS:
            works = names if text is None or package is emitters else WITHOUT_CACHE
            _load(package, variant, works)
            names = [n for n in names if n not in works]
        for name in names:
            register_plugin(name, _refusal(name, text))


def _load(package: ModuleType, variant: str, names: tuple[str, ...]) -> None:
    """Put ``variant``'s modules of ``package`` into place; the first visit executes those of the plugins `names`."""
    prefix = f"{package.__name__}."
    for name in [n for n in sys.modules if n.startswith(prefix)]:
        del sys.modules[name]

    known = _modules.get((package.__name__, variant))
    if known is None:
        for name in names:
            importlib.import_module(prefix + name)
        known = {n: m for n, m in sys.modules.items() if n.startswith(prefix)}
        _modules[package.__name__, variant] = known

    sys.modules.update(known)
    for name, module in known.items():
        setattr(package, name.removeprefix(prefix), module)


def _refusal(name: str, text: str):
    """A plugin constructor that only says why there is none."""

    def refuse(props):
        raise RuntimeError(f'"{name}": {text}')

    return refuse
