"""Formulas in TeX as a line of Unicode, for terminals: what the docstrings use, the rest left as it is."""

from __future__ import annotations

import re
from functools import cache

#: Accents as combining characters.
_ACCENTS = {"hat": "\u0302", "bar": "\u0304", "tilde": "\u0303", "vec": "\u20d7", "dot": "\u0307"}
#: Commands that only set what follows in another type.
_PLAIN = {"text", "mathrm", "mathbf", "mathit", "operatorname", "left", "right", "displaystyle"}
#: Spaces: of width 0, 1 and more.
_SPACES = {"!": "", ",": " ", ";": " ", ":": " ", " ": " ", "quad": "  ", "qquad": "   ", "\\": "\n"}
#: Indices that are numbers or count something; other letters are names and stay readable.
_SUBSCRIPTS = dict(zip("0123456789+-=()ijkn", "₀₁₂₃₄₅₆₇₈₉₊₋₌₍₎ᵢⱼₖₙ", strict=True))
_SUPERSCRIPTS = dict(zip("0123456789+-=()in", "⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻⁼⁽⁾ⁱⁿ", strict=True))
_TOKEN = re.compile(r"\\([A-Za-z]+|.)\s*|([{}^_])|(\s+)|(.)", re.DOTALL)


def to_text(tex: str) -> str:
    r"""``\frac{1}{N_c} \sum_i \omega_i`` as ``1/N_c ∑ᵢ ωᵢ``."""
    tokens = [m for m in _TOKEN.finditer(tex.strip())]
    text, _ = _sequence(tokens, 0)
    return re.sub(r" {2,}", " ", text).strip()


def _sequence(tokens, k: int, closing: str | None = None) -> tuple[str, int]:
    """The text of tokens from `k` up to `closing`, and where that ends."""
    out = ""
    while k < len(tokens):
        if tokens[k][2] == "}" and closing:
            return out, k + 1
        piece, k = _item(tokens, k)
        out += piece
    return out, k


def _item(tokens, k: int) -> tuple[str, int]:
    """The text of one thing: a group, a command with its arguments, a character."""
    command, brace, space, character = tokens[k].groups()
    if brace == "{":
        return _sequence(tokens, k + 1, "}")
    if brace in ("^", "_"):
        inner, k = _item(tokens, k + 1) if k + 1 < len(tokens) else ("", k + 1)
        table = _SUBSCRIPTS if brace == "_" else _SUPERSCRIPTS
        if inner and all(c in table for c in inner):
            return "".join(table[c] for c in inner), k
        return f"{brace}{inner}" if len(inner) < 2 or inner.isalnum() else f"{brace}({inner})", k
    if command is None:
        return (" " if space else character), k + 1
    if command in _SPACES:
        return _SPACES[command], k + 1
    if command in _PLAIN:
        return "", k + 1
    if command == "frac":
        above, k = _argument(tokens, k + 1)
        below, k = _argument(tokens, k)
        return f"{_grouped(above)}/{_grouped(below)}", k
    if command == "sqrt":
        inner, k = _argument(tokens, k + 1)
        return f"√{_grouped(inner)}", k
    if command in _ACCENTS:
        inner, k = _argument(tokens, k + 1)
        return inner + _ACCENTS[command], k
    symbols, operators = _symbols()
    spaced = tokens[k][0][-1].isspace() and (command not in symbols or command in operators)
    return symbols.get(command, command) + (" " if spaced else ""), k + 1


def _argument(tokens, k: int) -> tuple[str, int]:
    while k < len(tokens) and tokens[k][3]:
        k += 1
    return _item(tokens, k) if k < len(tokens) else ("", k)


def _grouped(text: str) -> str:
    """In parentheses, where a fraction would otherwise read wrongly."""
    text = text.strip()
    simple = re.fullmatch(r"[\w\u0300-\u036f₀-₉⁰-⁹]+", text) or (text[:1] + text[-1:] == "()" and "(" not in text[1:-1])
    return text if simple else f"({text})"


@cache
def _symbols() -> tuple[dict[str, str], set[str]]:
    """Commands that are one character, as docutils lists them; and those of them that stand between two things."""
    from docutils.utils.math import tex2unichar as known

    operators = known.mathbin | known.mathrel | {"mid": "|", "cdot": "·"}
    found = known.mathalpha | known.mathop | known.mathord | known.mathopen | known.mathclose | known.mathpunct
    return found | operators | {"cdots": "...", "ldots": "...", "|": "‖"}, set(operators)
