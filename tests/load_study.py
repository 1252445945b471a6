"""Scripts of the folder `studies/`, which is no package, as modules."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

FOLDER = Path(__file__).resolve().parents[1] / "studies"


def load_study(name: str) -> ModuleType:
    """`studies/NAME.py` as a module, the same one at every call; what it imports from its own folder is found."""
    module_name = f"studies_{name}"  # none that a library has
    if module_name not in sys.modules:
        spec = importlib.util.spec_from_file_location(module_name, FOLDER / f"{name}.py")
        sys.modules[module_name] = module = importlib.util.module_from_spec(spec)
        sys.path.append(str(FOLDER))
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[module_name]
            raise
        finally:
            sys.path.remove(str(FOLDER))
    return sys.modules[module_name]
