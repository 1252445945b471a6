"""LLVM: ours is taken where it can be, the user's choice is respected, and nothing is left to abort the process."""

import json
import sys

import pytest

from mi_neural import llvm

packaged = llvm.packaged_library()
needs_package = pytest.mark.skipif(packaged is None, reason="karellen-llvm-core is not installed here")

RENDER = """
box = mi.cornell_box()
box["sensor"]["film"] |= {"width": 8, "height": 8}  # the kernel is what matters
print("mean", mi.render(mi.load_dict(box), spp=1).array.numpy().mean())
"""
DESCRIBE = "import json; print(json.dumps(mi_neural.llvm.describe()))\n"


@pytest.fixture
def old_llvm(run_python):
    """Skips unless Dr.Jit, left alone on this machine, takes an LLVM that aborts (as on Debian 12)."""
    found = run_python("import drjit as dr; print(*dr.detail.llvm_version())").stdout.split()
    if not 15 <= int(found[0]) < llvm.MIN_VERSION:
        pytest.skip(f"the system's own LLVM is {'.'.join(found)}, not one that aborts")


@needs_package
def test_packaged_library_is_a_file_of_the_distribution():
    assert packaged.is_file() and packaged.name.startswith("libLLVM")


def test_distribution_without_library_is_no_error(monkeypatch):
    monkeypatch.setattr(llvm.importlib.metadata, "files", lambda name: None)
    assert llvm.packaged_library() is None


def test_absent_distribution_is_no_error(monkeypatch):
    monkeypatch.setattr(llvm, "DISTRIBUTION", "no-such-distribution")
    assert llvm.packaged_library() is None


@needs_package
def test_imported_first_the_packaged_library_is_used(run_python):
    out = run_python("import mi_neural, mitsuba as mi\n" + DESCRIBE).stdout
    assert json.loads(out)["source"] == "karellen-llvm-core"
    assert json.loads(out)["path"] == str(packaged)
    assert json.loads(out)["problem"] is None


@needs_package
def test_child_processes_say_the_same(run_python):
    out = run_python("import mi_neural\n" + DESCRIBE, DRJIT_LIBLLVM_PATH=str(packaged)).stdout
    assert json.loads(out)["source"] == "karellen-llvm-core"


@needs_package
def test_the_choice_of_the_user_is_respected(run_python):
    mine = next((p for p in sorted(packaged.parent.glob("libLLVM*.so*")) if p != packaged), None)
    if mine is None:
        pytest.skip("no second name for the library to tell the two choices apart")
    code = "import os, mi_neural; print(os.environ['DRJIT_LIBLLVM_PATH'])"
    assert run_python(code, DRJIT_LIBLLVM_PATH=str(mine)).stdout.strip() == str(mine)


def test_missing_file_named_by_the_user_is_one_clear_error(run_python):
    done = run_python("import mi_neural", ok=False, DRJIT_LIBLLVM_PATH="/no/such/libLLVM.so")
    assert done.returncode == 1
    assert done.stderr.strip().endswith("which does not exist. Type: unset DRJIT_LIBLLVM_PATH")


@needs_package
@pytest.mark.parametrize("first", ["", "mi.set_variant('scalar_rgb'); mi.load_dict({'type': 'sphere'})"])
def test_old_llvm_is_replaced_when_mitsuba_came_first(run_python, old_llvm, first):
    code = f"import mitsuba as mi; {first}\nimport mi_neural\nmi.set_variant('llvm_ad_rgb')\n" + RENDER + DESCRIBE
    out = run_python(code).stdout.splitlines()
    assert json.loads(out[-1])["source"] == "karellen-llvm-core"
    assert float(out[-2].split()[1]) > 0


@needs_package
def test_old_llvm_with_the_variant_set_first_is_one_clear_error(run_python, old_llvm):
    code = "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import mi_neural; print('imported')"
    done = run_python(code, ok=False)
    assert done.returncode == 1 and "imported" not in done.stdout
    assert "LLVM 15" in done.stderr or "LLVM 16" in done.stderr
    assert "Write `import mi_neural` above `import mitsuba`" in done.stderr


@needs_package
def test_no_llvm_with_mitsuba_first_is_one_clear_error(run_python):
    code = "import os, mitsuba as mi; del os.environ['DRJIT_LIBLLVM_PATH']; import mi_neural"
    done = run_python(code + "; mi.set_variant('llvm_ad_rgb')", ok=False, DRJIT_LIBLLVM_PATH="/no/such/libLLVM.so")
    assert done.returncode == 1
    assert "found no LLVM" in done.stderr and "Write `import mi_neural` above `import mitsuba`" in done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="the advice differs between systems")
@pytest.mark.parametrize("version", [None, (15, 0, 6)])
def test_without_the_package_it_says_what_to_install(monkeypatch, version):
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "packaged_library", lambda: None)
    monkeypatch.setattr(llvm, "version", lambda: version)
    monkeypatch.setattr(llvm, "MIN_VERSION", 17)
    monkeypatch.setattr(llvm.platform, "machine", lambda: "x86_64")
    assert llvm.problem().endswith("Type: pip install karellen-llvm-core")
    with pytest.raises(llvm.LLVMError, match="pip install"):
        llvm.check("llvm_ad_rgb")
    llvm.check("scalar_rgb")
    llvm.check("cuda_ad_rgb")


def test_old_llvm_chosen_by_the_user_names_the_variable(monkeypatch):
    monkeypatch.setenv(llvm.VARIABLE, "/usr/lib/libLLVM-15.so")
    monkeypatch.setattr(llvm, "version", lambda: (14, 0, 6))
    assert llvm.problem().endswith("Type: unset DRJIT_LIBLLVM_PATH")


@pytest.mark.parametrize("system, advice", [("darwin", "brew install llvm"), ("win32", "LLVM-C.dll")])
def test_other_systems_are_told_where_to_get_it(monkeypatch, system, advice):
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "packaged_library", lambda: None)
    monkeypatch.setattr(llvm, "version", lambda: None)
    monkeypatch.setattr(llvm.sys, "platform", system)
    assert advice in llvm.problem()
