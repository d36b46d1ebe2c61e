"""Makes this package's BSDFs known to Mitsuba, in whatever variant is chosen."""

from __future__ import annotations

import importlib
from functools import partial
from typing import Any

from nma.errors import ParamError
from nma.native import build
from nma.render.bsdf import VARIANTS

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

    if new == "scalar_rgb" and build.has_mitsuba_plugins():
        # Python ones of the same name would hide them.
        _add_resource(str(build.mitsuba_folder()))
        return
    for name, module in PLUGINS.items():
        runs = new in VARIANTS
        mi.register_bsdf(name, importlib.import_module(module).define() if runs else partial(_refuse, new))


def _refuse(variant: str, props: Any) -> Any:
    """In place of a BSDF, where a variant has none of ours."""
    raise ParamError(
        f"BSDF '{props.plugin_name()}' runs in the variants {' and '.join(VARIANTS)}, not in {variant}: its parameters "
        "are RGB and its code is vectorised; call mi.set_variant('llvm_ad_rgb') first, or make the plugin for "
        "scalar_rgb with `nma mitsuba build`"
    )


def _add_resource(folder: str) -> None:
    """Puts a folder on Mitsuba's resource path, once."""
    import mitsuba

    mi: Any = mitsuba  # its types do not know this function
    resources = mi.file_resolver()
    if folder not in [str(path) for path in resources]:
        resources.append(folder)
