"""Sphinx extension: formulas as MathML, made by docutils.

MathJax and KaTeX would be loaded from the network, pictures of formulas need LaTeX. Every current browser shows MathML.
"""

from __future__ import annotations

import re

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

#: Subscripts of several letters are names, not products.
NAMES = re.compile(r"_\{([A-Za-z]{2,})\}")


def mathml(tex: str, block: bool = False) -> str:
    """TeX as a `<math>` element."""
    return tex2mathml(NAMES.sub(r"_{\\mathrm{\1}}", tex), as_block=block)


def visit_inline(translator, node):
    translator.body.append(mathml(node.astext()))
    raise nodes.SkipNode


def visit_block(translator, node):
    translator.body.append(f'<div class="formula">{mathml(node.astext(), block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app):
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True}
