"""Registers this package's BSDF plugins with Mitsuba, in every variant that is chosen."""

from __future__ import annotations

import importlib
from functools import partial
from typing import Any

from nma.errors import ParamError
from nma.native import build
from nma.render.bsdf import VARIANTS
from nma.render.collector import spare_recordings

# Name of each plugin, and the module whose `define()` makes its class for the current variant.
PLUGINS = {
    "layered": "nma.render.layered",
    "nma": "nma.render.adapter_bsdf",
    "values": "nma.render.values_bsdf",
}

_registered = False


def register() -> None:
    """Registers the plugins now, if a variant is set, and again after every `mi.set_variant`. Further calls of this
    function do nothing.

    Mitsuba stores Python plugins separately for each variant. scalar_rgb and the `mitsuba` executable need compiled
    plugins, which `nma mitsuba build` compiles.
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

    compiled: tuple[str, ...] = ()
    if new == "scalar_rgb" and build.has_mitsuba_plugins():
        _add_resource(str(build.mitsuba_folder()))
        compiled = build.PLUGINS
    runs = new in VARIANTS
    if runs:
        spare_recordings()
    for name, module in PLUGINS.items():
        if name in compiled:  # a Python plugin of the same name would hide the compiled plugin
            continue
        mi.register_bsdf(name, importlib.import_module(module).define() if runs else partial(_refuse, new))


def _refuse(variant: str, props: Any) -> Any:
    """Raises an error when a scene needs one of our BSDFs in a variant in which our BSDFs do not run."""
    name = props.plugin_name()
    other = ", or make the plugin for scalar_rgb with `nma mitsuba build`" if name in build.PLUGINS else ""
    raise ParamError(
        f"BSDF '{name}' runs in the variants {' and '.join(VARIANTS)}, not in {variant}: its parameters "
        f"are RGB and its code is vectorised; call mi.set_variant('llvm_ad_rgb') first{other}"
    )


def _add_resource(folder: str) -> None:
    """Adds a folder to Mitsuba's resource path, unless the path already has the folder."""
    import mitsuba

    mi: Any = mitsuba  # Mitsuba's type stubs lack this function
    resources = mi.file_resolver()
    if folder not in [str(path) for path in resources]:
        resources.append(folder)
