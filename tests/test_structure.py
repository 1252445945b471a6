"""Structure: what is installed is what is there, imports go one way, and every key of a plugin has its row."""

import ast
import importlib
import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import pytest

import mi_neural
from mi_neural import emitters, integrators, registration

ROOT = Path(__file__).resolve().parents[1]

# Folder of each room of the package, as pyproject.toml maps it
FOLDERS = {"mi_neural.integrators": "integrators", "mi_neural.emitters": "emitters", "mi_neural.scenes": "scenes"}

# Imports go from higher to lower layers; rooms on one layer do not know one another.
LAYERS = [
    {"llvm", "scenes", "estimators", "image", "parameters"},
    {"render"},
    {"caches", "lights"},
    {"light_noise"},
    {"plan"},
    {"emitters"},  # light samplers do not know integrators
    {"integrators"},
    {"bench"},
    {"explore"},
    {"manual", "reproduce"},
    {"commands"},
    {"cli"},
    {"__main__"},
]
# The package's own start-up imports any room when a variant is set; others may ask it about the variant.
STARTUP = {"", "registration"}

# What must stay a function of samples or of features, whatever the scene
BLIND = ["caches/field.py", "caches/weights.py", "caches/encoding.py", "caches/loss.py", "estimators/two_level.py",
         "estimators/reservoir.py", "image/exr.py", "image/metrics.py", "image/moments.py",
         "image/denoise.py"]  # fmt: skip


def sources() -> dict[str, Path]:
    """All modules of the package: dotted name -> file."""
    found = {}
    for base, package in [(ROOT / "mi_neural", "mi_neural"), *((ROOT / f, p) for p, f in FOLDERS.items())]:
        for file in base.rglob("*.py"):
            parts = [package, *file.relative_to(base).with_suffix("").parts]
            found[".".join(parts).removesuffix(".__init__")] = file
    return found


SOURCES = sources()
TREES = {name: ast.parse(file.read_text(encoding="utf-8")) for name, file in SOURCES.items()}


def room(module: str) -> str:
    """'mi_neural.caches.field' -> 'caches'; '' for the package itself."""
    return [*module.split("."), ""][1]


def layer(module: str) -> int | None:
    return next((i for i, rooms in enumerate(LAYERS) if room(module) in rooms), None)


def imported(module: str) -> set[str]:
    """The modules of this package that `module` imports anywhere, at top level or inside functions."""
    is_package = SOURCES[module].name == "__init__.py"
    names = set()
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = module.split(".")[: len(module.split(".")) - node.level + is_package] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            # `from package import module` names a module, `from module import name` does not
            names |= {f"{origin}.{a.name}" if f"{origin}.{a.name}" in SOURCES else origin for a in node.names}
    return {n for n in names if n.split(".")[0] == "mi_neural"}


# ---------------------------------------------------------------- packaging


def project() -> dict:
    tomllib = pytest.importorskip("tomllib", reason="tomllib needs Python 3.11")
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_package_list_matches_the_folders():
    listed = set(project()["tool"]["setuptools"]["packages"])
    assert listed == {name for name, file in SOURCES.items() if file.name == "__init__.py"}
    homeless = [str(f) for f in SOURCES.values() if not (f.parent / "__init__.py").exists()]
    assert not homeless, f"folders without __init__.py: {homeless}"


def test_package_map_matches_the_folders():
    assert project()["tool"]["setuptools"]["package-dir"] == FOLDERS


def test_studies_and_tests_are_in_no_package():
    """What is installed are the listed packages alone, and neither folder lies in one of them."""
    settings = project()["tool"]["setuptools"]
    folders = {ROOT / settings["package-dir"].get(name, name.replace(".", "/")) for name in settings["packages"]}
    assert all(folder.is_dir() for folder in folders)
    for left_out in (ROOT / "studies", ROOT / "tests"):
        assert not folders & {left_out, *left_out.parents} and not (left_out / "__init__.py").exists()


def test_versions_agree():
    assert mi_neural.__version__ == project()["project"]["version"]
    assert re.search(rf"^version: {re.escape(mi_neural.__version__)}$", (ROOT / "CITATION.cff").read_text(), re.M)


def test_public_names_exist():
    for name in mi_neural.__all__:
        assert getattr(mi_neural, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = mi_neural.nonsense


@pytest.mark.parametrize("folder", ["integrators", "emitters"])
def test_plugin_folders_refuse_other_names(folder):
    done = subprocess.run([sys.executable, "-c", f"import {folder}"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1
    assert f"type: import mi_neural.{folder}" in done.stderr


# ---------------------------------------------------------------- layers


@pytest.mark.parametrize("module", sorted(SOURCES))
def test_imports_go_one_way(module):
    if room(module) in STARTUP:
        return
    assert layer(module) is not None, f"{module}: give its room a place in LAYERS"
    for other in imported(module):
        if room(other) in STARTUP or room(other) == room(module):
            continue
        assert layer(other) < layer(module), f"{module} imports {other}"


@pytest.mark.parametrize("package", [integrators, emitters], ids=["integrators", "emitters"])
def test_plugins_do_not_import_one_another(package):
    plugins = {f"{package.__name__}.{name}" for name in package.PLUGINS}
    for module in plugins & set(SOURCES):
        assert not imported(module) & plugins - {module}


@pytest.mark.parametrize("module", sorted(SOURCES))
def test_plugin_classes_live_in_plugin_folders(module):
    if room(module) in ("integrators", "emitters"):
        return
    aliases = {"mitsuba"}
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            aliases |= {a.asname for a in node.names if a.name.split(".")[0] == "mitsuba" and a.asname}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "mitsuba":
            aliases |= {a.asname or a.name for a in node.names}
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.ClassDef):
            roots = {ast.unparse(base).split(".")[0].split("[")[0] for base in node.bases}
            assert not roots & aliases, f"class {node.name} derives from a class of one variant"


def test_library_can_be_imported_without_a_variant(run_python):
    modules = [m for m in SOURCES if room(m) not in ("integrators", "emitters")]
    code = f"import importlib, mitsuba as mi\nfor m in {modules!r}: importlib.import_module(m)\nprint(mi.variant())"
    assert run_python("import mi_neural\n" + code).stdout.strip().splitlines()[-1] == "None"


@pytest.mark.parametrize("file", BLIND)
def test_pure_parts_know_neither_scene_nor_sampler(file):
    name = "mi_neural." + file.removesuffix(".py").replace("/", ".")
    if name not in TREES:
        pytest.skip("not written yet")
    for node in ast.walk(TREES[name]):
        assert not (isinstance(node, ast.arg) and node.arg in ("scene", "sampler")), f"line {node.lineno}"
        assert not (isinstance(node, ast.Attribute) and node.attr in ("Scene", "Sampler")), f"line {node.lineno}"


# ---------------------------------------------------------------- plugins

PLUGINS = [(p, name) for p in (integrators, emitters) for name in registration.plugin_names(p)]
IDS = [name for _, name in PLUGINS]

# Read by Mitsuba's own base classes from the same properties
INHERITED = {"max_depth", "rr_depth", "hide_emitters"}


def registers(node) -> bool:
    """Whether a piece of code makes a plugin known to Mitsuba."""
    if isinstance(node, ast.Attribute):
        return node.attr.startswith("register_")
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "register"


@pytest.mark.parametrize("package", [integrators, emitters], ids=["integrators", "emitters"])
def test_list_of_plugins_matches_the_files(package):
    registering = {
        name.rsplit(".", 1)[1]
        for name, tree in TREES.items()
        if name.startswith(package.__name__ + ".")
        and not name.endswith(".keys")  # where the function is that registers
        and any(registers(n) for n in ast.walk(tree))
    }
    assert registering == set(package.PLUGINS)


def plugin_class(package, name) -> type:
    """The final class of a plugin: the one that its module defines and its registration makes."""
    module = importlib.import_module(f"{package.__name__}.{name}")
    made = type(mi.load_dict({"type": name}))
    assert made.__module__ == module.__name__, "plugin type = file name"
    return made


def keys_read(cls: type) -> set[str]:
    """Keys that the modules of `cls` and of its bases in this package read from their `props`."""
    keys, modules = set(), {base.__module__ for base in cls.__mro__} & set(TREES)
    if any("blending_of(props, " in ast.unparse(TREES[module]) for module in modules):
        modules.add("mi_neural.integrators.blending")
    for module in modules:
        for node in ast.walk(TREES[module]):
            if isinstance(node, ast.Call) and ast.unparse(node) == "light_sampler_of(props)":
                keys.add("light_sampler")
                continue
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.args:
                asks = node.func.attr in ("get", "has_property", "string", "get_string", "get_texture")
                owner, key = node.func.value, node.args[0]
            elif isinstance(node, ast.Subscript):
                asks, owner, key = True, node.value, node.slice
            elif isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
                asks, owner, key = True, node.comparators[0], node.left
            else:
                continue
            if asks and ast.unparse(owner) == "props" and isinstance(key, ast.Constant) and isinstance(key.value, str):
                keys.add(key.value)
    return keys


def table_rows(cls: type) -> set[str]:
    """Keys in the first column of the parameter table (`* - key` in `.. pluginparameters::`) of the docstring."""
    table = (cls.__doc__ or "").partition(".. pluginparameters::")[2]
    rows = re.findall(r"^\s*\* - (.+)$", table, re.M)
    return {key.strip(" `|") for row in rows for key in row.split(",")}


def test_reading_of_keys_and_rows():
    """The two readers above find what they should, on a plugin of this test's own."""
    code = 'def __init__(self, props):\n    props.get("a", 1); props["b"]; "c" in props; other.get("no"); props.get(x)'
    doc = "Title\n.. pluginparameters::\n\n     * - a\n       - |int|\n     * - b, c\n       - |bool|\n"
    cls = type("P", (), {"__doc__": doc, "__module__": "probe"})
    TREES["probe"] = ast.parse(code)
    try:
        assert keys_read(cls) == table_rows(cls) == {"a", "b", "c"}
    finally:
        del TREES["probe"]


@pytest.mark.parametrize("package, name", PLUGINS, ids=IDS)
def test_every_key_has_its_row(package, name):
    cls = plugin_class(package, name)
    read, rows = keys_read(cls), table_rows(cls)
    assert rows, "no table: write one under `.. pluginparameters::` in the docstring of the class"
    assert read <= rows, f"read but not in the table: {sorted(read - rows)}"
    rows -= {"(none)"}
    assert rows <= read | INHERITED, f"in the table but never read: {sorted(rows - read - INHERITED)}"


@pytest.mark.parametrize("package, name", PLUGINS, ids=IDS)
def test_plugin_describes_itself(package, name):
    assert "to_string" in {n for base in plugin_class(package, name).__mro__[:-1] for n in vars(base)}
    assert str(mi.load_dict({"type": name}))
