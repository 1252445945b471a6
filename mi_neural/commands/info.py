"""`mi-neural info`: what is installed."""

from __future__ import annotations

from rich.table import Table

from mi_neural.bench import environment, terminal
from mi_neural.commands import options


@options.readable
def info() -> None:
    """Show versions, variants, LLVM, cores, plugins and scenes."""
    import mitsuba as mi

    import mi_neural
    from mi_neural import emitters, integrators, registration, scenes

    facts = environment.describe()
    llvm = mi_neural.llvm.describe()
    facts["variant"] = (
        f"{terminal.DEFAULT_VARIANT} by default; all plugins work under {', '.join(registration.SUPPORTED)}, "
        f"{', '.join(registration.WITHOUT_CACHE)} and light samplers under {', '.join(registration.OTHER_COLOURS)}, too"
    )
    facts["llvm"] = llvm["version"] and f"{llvm['version']} from {llvm['source']}: {llvm['path']}"
    del facts["llvm_source"]
    if llvm["problem"]:
        facts["llvm problem"] = llvm["problem"]
    facts["variants"] = ", ".join(mi.variants())
    facts["integrators"] = ", ".join(registration.plugin_names(integrators))
    facts["emitters"] = ", ".join(registration.plugin_names(emitters))
    facts["scenes"] = ", ".join(scenes.names())

    table = Table.grid(padding=(0, 2))
    for name, value in facts.items():
        missing = "not installed: pip install 'mi_neural[denoise]'" if name == "mitsuba-oidn" else "none"
        table.add_row(name, str(value or missing))
    terminal.out.print(table)
