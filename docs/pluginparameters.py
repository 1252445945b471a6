"""Sphinx extension: the directives that Mitsuba's and this package's plugin docstrings use."""

from __future__ import annotations

from mi_neural.manual.directives import DIRECTIVES, naming


def setup(app):
    for name, directive in DIRECTIVES.items():
        app.add_directive(name, directive)
    app.add_role("monosp", naming)
    return {"parallel_read_safe": True}
