"""Configuration of the manual. `make docs` writes its pages with `stage.py`, then runs sphinx-build with this file.

Pages come from one source each: guides from `mi_neural/manual/*.md`, which `mi-neural doc` shows as well; plugins from
the docstrings of their classes; commands from `--help`; notebooks with the outputs that they are kept with.
"""

import importlib
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import mi_neural

project = "mi_neural"
author = "the mi_neural authors"
release = version = mi_neural.__version__
copyright = "the mi_neural authors. BSD-3-Clause"

extensions = ["sphinx.ext.autodoc", "myst_nb", "pluginparameters", "docstrings", "mathml"]
default_role = "code"  # `name` in a docstring is code
nitpicky = True
show_warning_types = True
suppress_warnings = []

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "none"  # shapes and units are in the texts; the signatures keep names and defaults
autodoc_preserve_defaults = True

# Notebooks are rendered with the outputs that they hold. `make notebooks` runs them.
nb_execution_mode = "off"
nb_merge_streams = True
# Live views need a kernel: a page shows the picture that the notebook keeps for readers without one
nb_mime_priority_overrides = [
    ("html", "image/png", 0), ("html", "text/html", 5), ("html", "application/vnd.jupyter.widget-view+json", None),
]  # fmt: skip
nb_ipywidgets_js = {}  # from a server of others; a page reads nothing from the network
myst_heading_anchors = 3
html_math_renderer = "mathml"

html_theme = "furo"
html_title = f"mi_neural {version}"
html_static_path = ["_static"]
html_css_files = ["manual.css"]
html_show_sourcelink = False
html_copy_source = False


def variant() -> None:
    """Set a variant, so that there are plugins, and import all that may be named."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    for name in ("emitters", "integrators", "plan", "bench", "explore.session"):
        importlib.import_module(f"mi_neural.{name}")


variant()
