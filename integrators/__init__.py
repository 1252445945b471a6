"""Integrator plugins, one algorithm per file, file name = plugin type. Installed as ``mi_neural.integrators``.

A plugin module defines its classes at top level, deriving from ``mi.*``, and ends, as Mitsuba's own do, with

    mi.register_integrator("nirc", lambda props: NIRCIntegrator(props))

It is executed once under each supported variant (:mod:`mi_neural.registration`), with module globals of its own, so it
needs no ``reload`` and no check of the variant: under any other variant its name is registered with a constructor that
says what to type. Listed here and written there is all that a new plugin needs; helper modules are not listed.
"""

if __name__ != "mi_neural.integrators":
    raise ImportError(f"'{__name__}' is the source folder of mi_neural.integrators; type: import mi_neural.integrators")

PLUGINS = ("plain_path", "nirc", "nirc_two_level", "nrc", "neural_path", "nvc_direct", "restir_di")
