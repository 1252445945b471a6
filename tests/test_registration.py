"""Registration: before or after the variant is set, at every switch, and never in the user's way."""

import mitsuba as mi
import pytest

import mi_neural
from mi_neural import integrators, registration

PLUGINS = registration.plugin_names(integrators)
FIRST = PLUGINS[0] if PLUGINS else "none"
needs_plugin = pytest.mark.skipif(not PLUGINS, reason="no plugin module exists yet")

LOAD = f"print(type(mi.load_dict({{'type': '{FIRST}'}})).__module__)\n"
CELL = f"mi_neural.integrators.{FIRST}"

# A package of one plugin, put in the place of `integrators`; llvm_ad_mono stands for a second supported variant.
PROBE = """
import pathlib, sys
import mi_neural, mitsuba as mi
from mi_neural import integrators, registration
pathlib.Path("probe_base.py").write_text('''
import mitsuba as mi
class Base(mi.SamplingIntegrator):
    def to_string(self): return self.name()
''')
pathlib.Path("probe.py").write_text('''
import mitsuba as mi
from .probe_base import Base
VARIANT = mi.variant()
class Probe(Base):
    def __init__(self, props): super(Probe, self).__init__(props)
    def name(self): return "Probe " + VARIANT
    def sample(self, scene, sampler, ray, medium, active):
        assert isinstance(self, Probe) and VARIANT == mi.variant()
        return mi.Spectrum(0.25), mi.Bool(True), []
mi.register_integrator("probe", lambda props: Probe(props))
''')
integrators.__path__.append(".")
integrators.PLUGINS = ("probe",)
registration.SUPPORTED += ("llvm_ad_mono",); registration.OTHER_COLOURS = ()
def mean(integrator):
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film":
        {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "luminance", "rfilter": {"type": "box"}}}})
    return float(mi.render(scene, integrator=integrator, spp=1).array.numpy().mean())
"""


@needs_plugin
@pytest.mark.parametrize(
    "order",
    [
        "import mi_neural; import mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n",
        "import mitsuba as mi; import mi_neural; mi.set_variant('llvm_ad_rgb')\n",
        "import mi_neural; import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); mi_neural.register()\n",
    ],
    ids=["before", "after mitsuba", "twice"],
)
def test_plugins_are_found_whatever_the_order(run_python, order):
    assert run_python(order + LOAD).stdout.strip() == CELL


@needs_plugin
def test_plugins_are_found_when_the_variant_was_set_first(run_python):
    code = "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import mi_neural\n" + LOAD
    # an LLVM that works, since Mitsuba chooses before we are asked
    path = mi_neural.llvm.describe()["path"]
    assert run_python(code, **({"DRJIT_LIBLLVM_PATH": path} if path else {})).stdout.strip() == CELL


def test_import_sets_no_variant(run_python):
    assert run_python("import mi_neural, mitsuba as mi; print(mi.variant())").stdout.strip() == "None"
    code = "import mitsuba as mi; mi.set_variant('scalar_rgb'); import mi_neural; print(mi.variant())"
    assert run_python(code).stdout.strip() == "scalar_rgb"


def test_import_leaves_threads_and_log_level_alone(run_python):
    code = """
import mitsuba as mi, drjit as dr
mi.set_variant("scalar_rgb")
dr.set_thread_count(1); mi.set_log_level(mi.LogLevel.Error)
import mi_neural
print(dr.thread_count(), mi.log_level() == mi.LogLevel.Error)
"""
    assert run_python(code).stdout.strip() == "1 True"


def test_import_is_light(run_python):
    heavy = ("matplotlib", "typer", "rich", "OpenEXR", "scipy", "IPython")
    code = f"import mi_neural, sys; print([m for m in {heavy} if m in sys.modules])"
    assert run_python(code).stdout.strip() == "[]"


@needs_plugin
@pytest.mark.parametrize("unsupported", [v for v in mi.variants() if v.startswith(("scalar", "llvm"))])
def test_unsupported_variants_say_what_to_type(unsupported):
    if unsupported in registration.SUPPORTED:
        pytest.skip("supported")
    mi.set_variant(unsupported)
    works = registration.WITHOUT_CACHE if unsupported in registration.OTHER_COLOURS else ()
    for name in (n for n in PLUGINS if n not in works):
        with pytest.raises(RuntimeError, match=r'does not support the variant .*mi\.set_variant\("llvm_ad_rgb"\)'):
            mi.load_dict({"type": "scene", "integrator": {"type": name}})


@pytest.mark.parametrize(
    "variant, reason",
    [
        ("scalar_rgb", "scalar"),
        ("llvm_ad_spectral_polarized", "polarization"),
        ("cuda_ad_spectral", "RGB"),
        ("llvm_ad_mono", "RGB"),
        ("llvm_rgb", "differentiation"),
    ],
)
def test_variant_problem_gives_the_reason(variant, reason):
    assert reason in mi_neural.variant_problem(variant)


def test_supported_variants_have_no_problem():
    assert mi_neural.variant_problem() is None
    assert mi_neural.variant_problem("llvm_ad_rgb") is None
    assert mi_neural.variant_problem("cuda_ad_rgb") is None


def test_no_variant_is_a_problem_with_a_cure(run_python):
    out = run_python("import mi_neural; print(mi_neural.variant_problem())").stdout
    assert "no Mitsuba variant is set; type: mi.set_variant" in out


@needs_plugin
def test_plugins_survive_a_visit_to_another_variant(variant):
    for name in PLUGINS:
        mine = mi.load_dict({"type": name})
        mi.set_variant("scalar_rgb")
        mi.set_variant(variant)
        assert type(mi.load_dict({"type": name})) is type(mine)
        assert name in str(mine) or type(mine).__name__ in str(mine)


def test_each_variant_keeps_its_own_classes(run_python):
    code = (
        PROBE
        + """
made, images = {}, []
for v in ("llvm_ad_rgb", "llvm_ad_mono", "scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(v)
    if v == "scalar_rgb":
        continue
    new = mi.load_dict({"type": "probe"})
    old = made.setdefault(v, new)
    assert type(old) is type(new) is sys.modules["mi_neural.integrators.probe"].Probe is integrators.probe.Probe
    assert str(old) == f"Probe {v}"
    assert isinstance(old, sys.modules["mi_neural.integrators.probe_base"].Base)
    assert mean(old) == mean(new) == 0.25
assert type(made["llvm_ad_rgb"]) is not type(made["llvm_ad_mono"])
print("kept")
"""
    )
    assert run_python(code).stdout.strip() == "kept"


def test_plugin_loads_from_xml(run_python):
    code = (
        PROBE
        + """
mi.set_variant("llvm_ad_rgb")
scene = mi.load_string('<scene version="3.0.0"><integrator type="probe"/></scene>')
print(scene.integrator().name())
assert "Probe" in str(scene)
"""
    )
    assert run_python(code).stdout.startswith("Probe llvm_ad_rgb")
