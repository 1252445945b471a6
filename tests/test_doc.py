"""The manual: every page can be read, every key is in it, every command it names exists."""

import io
import re
import shlex

import mitsuba as mi
import pytest
import typer
from rich.console import Console
from test_structure import plugin_class, table_rows
from typer.testing import CliRunner

from mi_neural import cli, emitters, integrators
from mi_neural.manual import directives, mathtext, pages, terminal

PLUGINS = list(pages.plugins())
GUIDES = list(pages.guides())


def shown(renderable, width=100) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(renderable)
    return console.export_text()


def doc(*words: str):
    return CliRunner().invoke(cli.app, ["doc", *words])


# ---------------------------------------------------------------- plugins


@pytest.mark.parametrize("name", PLUGINS)
def test_every_plugin_has_a_page_with_all_its_keys(name):
    page = pages.plugin_page(name)
    package = integrators if page.kind == "integrator" else emitters
    rows = table_rows(plugin_class(package, name))
    assert {k.strip(" `") for key in page.keys for k in key.name.split(",")} == rows
    text = shown(terminal.page(page))
    assert f"({name})" in text and page.title in text.replace("\n", " ")
    for key in page.keys:
        assert re.search(rf"^ ?{re.escape(key.name)}\b|^\(none\)", text, re.M), f"{key.name} starts no line"
        if key.name != "(none)":
            assert set(key.type.split(" or ")) <= set(directives.TYPES) and key.text
    assert f'type="{name}"' in text and f'"type": "{name}"' in re.sub(r"\s+", " ", text), "XML and Python to paste"
    assert not re.search(r":\w+:`|\.\. \w+|\\frac|\\sum|``|\|int\|", text), "markup is left in the text"


@pytest.mark.parametrize("name", PLUGINS)
def test_defaults_on_the_page_are_those_of_the_plugin(name):
    made = mi.load_dict({"type": name})
    for key in pages.plugin_page(name).keys:
        own = getattr(made, key.name, None)
        if key.type in ("int", "float") and type(own) in (int, float) and re.fullmatch(r"-?[\d.e-]+", key.default):
            assert float(key.default) == pytest.approx(own), key.name
        if key.type == "bool" and type(own) is bool and key.default in ("true", "false"):
            assert (key.default == "true") == own, key.name


def test_rows_may_come_from_strings_with_other_indents():
    text = """
    Title (:monosp:`x`)
    -------------------

    Some :math:`\\omega` and ``code``.

    .. pluginparameters::

     * - a
       - |int|
       - What it is, of
         two lines. (Default: 3)
         * - b
       - |string|
       - No default.

    .. tabs::
        .. code-tab:: xml

            <x/>
    """
    page = pages.parse("x", "integrator", text)
    assert [(k.name, k.type, k.text, k.default) for k in page.keys] == [
        ("a", "int", "What it is, of two lines.", "3"),
        ("b", "string", "No default.", ""),
    ]
    assert "Some ω and code." in shown(terminal.page(page)) and "<x/>" in shown(terminal.page(page))


def test_a_broken_docstring_is_reported():
    with pytest.raises(pages.PageError, match="manual page of 'x' cannot be read"):
        pages.parse("x", "integrator", "Some |nonsense|.")


@pytest.mark.parametrize(
    "tex, text",
    [
        (r"\frac{1}{N_c} \sum_i \omega_i", "1/N_c ∑ᵢ ωᵢ"),
        (r"\frac{a + b}{p(\omega)} \cdot x^2", "(a + b)/(p(ω)) · x²"),
        (r"\hat p(y \mid u)", "p̂(y | u)"),
        (r"a > c\,a_0", "a > c a₀"),
        (r"\sqrt{|x_{i-1}|}", "√(|xᵢ₋₁|)"),
        (r"L_{direct} \qquad \unknown{z}", "L_direct unknownz"),
        ("", ""),
    ],
)
def test_formulas_as_text(tex, text):
    assert mathtext.to_text(tex) == text


# ---------------------------------------------------------------- command


def test_doc_lists_prints_and_refuses():
    listed = doc()
    assert listed.exit_code == 0
    for name in (*PLUGINS, *GUIDES):
        assert re.search(rf"^{name}\b", listed.output, re.M)
    assert "\x1b" not in doc("nirc").output, "plain text when it is piped"
    assert "cache_samples" in doc("nirc").output
    wrong = doc("nrci")
    assert wrong.exit_code == 2 and "did you mean 'nrc'" in wrong.output


# ---------------------------------------------------------------- guides and README


@pytest.mark.parametrize("name", GUIDES)
def test_guides_can_be_printed(name):
    text = shown(terminal.guide(pages.guide(name)))
    assert pages.guides()[name] in text
    assert "<!--" not in text, "marks are for those who write"


def commands_in(markdown: str) -> list[list[str]]:
    """Every ``mi-neural ...`` line of code blocks, as words; `...` ends one."""
    lines = re.findall(r"^    (?:\S*/)?(mi-neural .*)$", markdown, re.M)
    return [shlex.split(line.replace("...", ""), comments=True)[1:] for line in lines]


def test_commands_of_guides_and_readme_exist(root):
    texts = [pages.guide(name) for name in GUIDES] + [(root / "README.md").read_text(encoding="utf-8")]
    found = [words for text in texts for words in commands_in(text)]
    assert len(found) > 5
    program = typer.main.get_command(cli.app)
    for words in found:
        command, names = program, []
        while hasattr(command, "commands") and len(names) < len(words):  # a command, or one below it
            assert words[len(names)] in command.commands, f"mi-neural {' '.join(words)}"
            names.append(words[len(names)])
            command = command.commands[names[-1]]
        options = [w for w in words[1:] if re.match(r"--?[a-zA-Z]", w)]
        help_ = CliRunner().invoke(cli.app, [*names, "--help"]).output
        for option in options:
            assert re.search(rf"(^|\s|,){re.escape(option)}\b", help_), f"mi-neural {' '.join(names)} has no {option}"


def test_modules_that_guides_and_readme_run_exist(root):
    from importlib.util import find_spec

    texts = [pages.guide(name) for name in GUIDES] + [(root / "README.md").read_text(encoding="utf-8")]
    for module in {m for text in texts for m in re.findall(r"python -m (mi_neural[\w.]+)", text)}:
        assert find_spec(module) is not None, module
