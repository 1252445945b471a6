"""Sphinx extension: docstrings of functions and classes as they are written here, for autodoc.

Names and what they mean stand in two columns, and an indented block is code:

    width   of the picture, in pixels
    spp     samples a pixel
"""

from __future__ import annotations

import ast
import builtins
import importlib
import importlib.util
import inspect
import re
from pathlib import Path

#: A name and what it means; a name whose meaning begins in the next line.
ROW, NAME = re.compile(r"(\S+(?:,? \S+)*?) {2,}(\S.*)"), re.compile(r"(\w+(?:, \w+)*)()")


def converted(lines: list[str]) -> list[str]:
    """The lines of a docstring as reStructuredText: two columns as a definition list, indented blocks as code."""
    out: list[str] = []
    k = 0
    while k < len(lines):
        start = k
        while k < len(lines) and lines[k].strip():
            k += 1
        block = lines[start:k]
        if block:
            out += _block(block, out)
        while k < len(lines) and not lines[k].strip():
            k += 1
        out.append("")
    return out


def _block(block: list[str], before: list[str]) -> list[str]:
    """One paragraph. `before` are the lines before it, which say whether an indented one is code already."""
    first = next((line for line in reversed(before) if line.strip()), "")
    if block[0].startswith(("    ", "\t")):
        inside = first.endswith("::") or first.startswith((" ", ".. "))
        return block if inside else [f".. code-block:: {_language(block)}", "", *block]
    block = [_escaped(line) for line in block]
    heads = [line for line in block if not line.startswith(" ")]
    marked = block[0].startswith(("..", ">>>", "+", "=", "* ", "- ", " "))
    two_columns = not marked and ROW.fullmatch(heads[0]) and all(ROW.fullmatch(h) or NAME.fullmatch(h) for h in heads)
    return _definitions(block) if two_columns else block


def _escaped(line: str) -> str:
    """The line with bars, as in |x|, and underscores at the ends of words as they are, outside of code."""
    parts = re.split(r"(`+[^`]*`+_*)", line)
    return "".join(p if p.startswith("`") else re.sub(r"(\||(?<=\w)_(?!\w))", r"\\\1", p) for p in parts)


def _language(block: list[str]) -> str:
    try:
        ast.parse(inspect.cleandoc("\n" + "\n".join(block)))
    except SyntaxError:
        return "text"
    return "python"


def _definitions(block: list[str]) -> list[str]:
    out = []
    for line in block:
        found = not line.startswith(" ") and (ROW.fullmatch(line) or NAME.fullmatch(line))
        if found:
            name, text = found.groups()
            shown = name if name.startswith(("`", ":")) else f"``{name}``"
            out += [shown, *([f"    {text}"] if text else [])]
        else:
            out.append(f"    {line.strip()}")
    return out


def process(app, what, name, obj, options, lines):
    lines[:] = converted(lines)


def missing(app, env, node, contnode):
    """A name in Python without a page of its own is shown as code; one that does not exist is a warning of Sphinx."""
    if node.get("refdomain") != "py":
        return None
    target, module, owner = node["reftarget"], node.get("py:module"), node.get("py:class")
    candidates = [target, f"{module}.{target}", f"{module}.{owner}.{target}", f"{module}{target}"]
    candidates.append(f"{(module or '').rpartition('.')[0]}.{target.lstrip('.')}")
    if owner and hasattr(importlib.import_module(module), owner):
        candidates.append(f"{getattr(importlib.import_module(module), owner).__module__}.{target}")
    candidates += [f"mi_neural.{target}", re.sub(r"^mi\.", "mitsuba.", target), re.sub(r"^dr\.", "drjit.", target)]
    return contnode if any(exists(c) for c in candidates) else None


def exists(dotted: str) -> bool:
    """Whether a dotted name is a builtin or a module, or can be reached in one."""
    parts = dotted.split(".")
    for k in range(len(parts), 0, -1):
        module, names = ".".join(parts[:k]), parts[k:]
        try:
            return _within(importlib.import_module(module), names)
        except ModuleNotFoundError as error:
            text = "" if (module + ".").startswith(f"{error.name}.") else _source(module)
            if text:  # the module is there, but needs what is not installed here
                return not names or re.search(rf"^(class|def) {names[0]}\b", text, re.M) is not None
        except (ValueError, TypeError):
            continue
    return hasattr(builtins, dotted)


def _within(found, names: list[str]) -> bool:
    for name in names:
        if name in {*getattr(found, "__dataclass_fields__", ()), *getattr(found, "__annotations__", ())}:
            return True
        if not hasattr(found, name):
            return False
        found = getattr(found, name)
    return True


def _source(module: str) -> str:
    try:
        found = importlib.util.find_spec(module)
    except ModuleNotFoundError:
        return ""
    return Path(found.origin).read_text(encoding="utf-8") if found and found.origin else ""


def setup(app):
    app.connect("autodoc-process-docstring", process)
    app.connect("missing-reference", missing)
    return {"parallel_read_safe": True}
