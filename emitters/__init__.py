"""Light samplers as nested plugins, one per file, file name = plugin type. Installed as ``mi_neural.emitters``.

The contract is that of ``mi_neural.integrators``; a module ends with ``mi.register_emitter("...", lambda props: ...)``.
"""

if __name__ != "mi_neural.emitters":
    raise ImportError(f"'{__name__}' is the source folder of mi_neural.emitters; type: import mi_neural.emitters")

PLUGINS = ("uniform_lights", "power_lights", "tree_lights", "nvc_lights")
