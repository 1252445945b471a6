"""What Mitsuba's docstrings use beyond reStructuredText: for docutils in the terminal, and for the HTML manual."""

from __future__ import annotations

import re

from docutils import nodes
from docutils.parsers.rst import Directive, directives, roles
from docutils.statemachine import StringList

#: The kinds of values a key takes, written as ``|int|`` in the tables.
TYPES = ("int", "float", "bool", "string", "emitter", "bsdf", "texture", "spectrum", "transform", "point", "vector")
#: Roles of Sphinx that stand for a name in code here.
NAMING_ROLES = ("monosp", "class", "meth", "func", "mod", "ref", "attr")
#: To be put behind a docstring, so that ``|int|`` is known in it.
SUBSTITUTIONS = "\n\n" + "".join(f".. |{name}| replace:: {name}\n" for name in TYPES)


class Parameters(Directive):
    """`.. pluginparameters::`: a list of rows (key, type, text), as a table of class `parameters`."""

    has_content = True

    def run(self):
        # Rows may come from several strings with different indents; what counts is the bullets
        lines = [re.sub(r"^\s*(\* -|-)?(?= |$)\s*", lambda m: {"* -": "* - ", "-": "  - "}.get(m[1], "    "), line)
                 for line in self.content]  # fmt: skip
        text = [".. list-table::", "    :class: parameters", "    :widths: 18 8 74", ""]
        holder = nodes.Element()
        self.state.nested_parse(StringList([*text, *("    " + line for line in lines)], "table"), 0, holder)
        return holder.children


class Tabs(Directive):
    """`.. tabs::`: its tabs one after the other."""

    has_content = True

    def run(self):
        holder = nodes.container(classes=["tabs"])
        self.state.nested_parse(self.content, self.content_offset, holder)
        return [holder]


class CodeTab(Directive):
    """`.. code-tab:: xml`: a block of code in that language."""

    has_content, required_arguments, optional_arguments = True, 1, 1

    def run(self):
        text, language = "\n".join(self.content), self.arguments[0]
        return [nodes.literal_block(text, text, classes=["code", language], language=language)]


DIRECTIVES = {"pluginparameters": Parameters, "tabs": Tabs, "code-tab": CodeTab}


def naming(role, rawtext, text, lineno, inliner, options=None, content=None):
    """A name as code; of ``~a.b`` its last part."""
    shown = text.rpartition(".")[2] if text.startswith("~") else text
    return [nodes.literal(rawtext, shown)], []


def register() -> None:
    """Teach docutils these directives and roles. Sphinx has roles of its own and takes :data:`DIRECTIVES` alone."""
    for name, directive in DIRECTIVES.items():
        directives.register_directive(name, directive)
    for name in NAMING_ROLES:
        roles.register_local_role(name, naming)
