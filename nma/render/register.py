"""Makes this package's BSDFs known to Mitsuba, in whatever variant is chosen."""

from __future__ import annotations

import importlib
from typing import Any

from nma import native

# Name of the plugin, and the module whose `define()` makes its class for the present variant.
PLUGINS = {
    "layered": "nma.render.layered",
    "nma": "nma.render.adapter_bsdf",
    "values": "nma.render.values_bsdf",
}

_registered = False


def register() -> None:
    """Registers the plugins now, if a variant is set, and again after every `mi.set_variant`. Harmless to repeat.

    Mitsuba keeps Python plugins per variant. For scalar_rgb and the `mitsuba` executable there are compiled ones: `nma
    mitsuba build`.
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

    if new == "scalar_rgb" and native.has_mitsuba_plugins():
        # Python ones of the same name would hide them.
        _add_resource(str(native.mitsuba_folder()))
        return
    for name, module in PLUGINS.items():
        mi.register_bsdf(name, importlib.import_module(module).define())


def _add_resource(folder: str) -> None:
    """Puts a folder on Mitsuba's resource path, once."""
    import mitsuba

    mi: Any = mitsuba  # its types do not know this function
    resources = mi.file_resolver()
    if folder not in [str(path) for path in resources]:
        resources.append(folder)
