"""`mi-neural plan`: what an integrator would model in a scene, what it would leave out, and why."""

from __future__ import annotations

import json
from typing import Annotated

import typer
from rich.table import Table

from mi_neural.bench import benchmark, load, terminal
from mi_neural.bench.load import InputError
from mi_neural.bench.specs import parse_integrator, parse_keys
from mi_neural.commands import options


@options.readable
def plan(
    scene: options.Scene,
    integrator: Annotated[
        str | None,
        typer.Option("-i", "--integrator", metavar="TYPE[:K=V,...]", help="an integrator and its keys; default: nirc"),
    ] = None,
    set_: options.Set = None,
    define: options.Define = None,
    size: options.Size = None,
    variant: options.Variant = terminal.DEFAULT_VARIANT,
    json_: Annotated[bool, typer.Option("--json", help="print it as JSON")] = False,
) -> None:
    """Show what an integrator builds in SCENE, what it leaves out, and why. Nothing is rendered."""
    spec = parse_integrator(integrator or "nirc")
    wanted_size, keys, parameters = (
        terminal.parse_size(size),
        parse_keys(set_ or []),
        terminal.parse_define(define),
    )
    terminal.set_variant(variant)
    loaded = load.load_scene(scene, wanted_size, parameters)
    (case,) = benchmark.make_cases(loaded, [spec], keys)
    if not hasattr(case.integrator, "make_plan"):
        raise InputError(f"{spec.type} models nothing that a plan could leave out; give -i nirc, nrc or nirc_two_level")
    made = case.integrator.make_plan(loaded.scene)
    if json_:
        terminal.out.print_json(json.dumps({"scene": loaded.name, **made.to_json()}))
        return

    facts = Table.grid(padding=(0, 2))
    for name, value in made.to_json()["facts"].items():
        facts.add_row(name, _text(value))
    decisions = Table("part", "", "because", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for row in made.rows():
        decisions.add_row(*row)
    terminal.out.print(f"{loaded.name}, {spec.label}", markup=False)
    terminal.out.print(facts)
    terminal.out.print()
    terminal.out.print(decisions)


def _text(value: object) -> str:
    """A fact as a user reads it."""
    if isinstance(value, dict):
        return ", ".join(f"{n} {kind}" for kind, n in value.items()) or "none"
    if isinstance(value, list):
        return " to ".join(f"{v:.3g}" for v in value) if isinstance(value[0], float) else "x".join(map(str, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "unknown" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
