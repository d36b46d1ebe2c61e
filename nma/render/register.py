"""Makes this package's BSDFs known to Mitsuba, in whatever variant is chosen."""

from __future__ import annotations

import importlib

# Name of the plugin, and the module whose `define()` makes its class for the present variant.
PLUGINS = {
    "layered": "nma.render.layered",
    "nma": "nma.render.adapter_bsdf",
}

_registered = False


def register() -> None:
    """Registers the plugins now, if a variant is set, and again after every `mi.set_variant`. Harmless to repeat.

    Mitsuba keeps Python plugins per variant. The `mitsuba` executable does not see them; `nma render` reads XML scenes.
    """
    global _registered
    import mitsuba as mi

    if _registered:
        return
    _registered = True
    mi.detail.add_variant_callback(_on_variant)
    if variant := mi.variant():
        _on_variant(None, variant)


def _on_variant(old: str | None, new: str) -> None:
    import mitsuba as mi

    for name, module in PLUGINS.items():
        mi.register_bsdf(name, importlib.import_module(module).define())
