"""Neural Material Adapter: a tiny network translates an expensive material into a blend of Principled BRDFs.

The names below are the public interface. Each name is imported when it is first used, so `import nma` is fast.
`import nma.render` registers the BSDFs `nma`, `layered` and `values` with Mitsuba. docs/python.md has examples.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from nma.adapter import Adapter as Adapter
    from nma.adapter import shipped as shipped
    from nma.adapter.library import Library as Library
    from nma.adapter.values import AdapterValues as AdapterValues
    from nma.errors import NmaError as NmaError
    from nma.evaluate import evaluate as evaluate_adapter  # noqa: F401
    from nma.evaluate import tabulate_adapter as tabulate_adapter
    from nma.evaluate.pairs import compare as compare_values  # noqa: F401
    from nma.images.metrics import compare_images as compare_images
    from nma.materials import load as load_material  # noqa: F401
    from nma.materials import names as material_names  # noqa: F401
    from nma.native.runtime import Runtime as Runtime
    from nma.params import LAYERED3 as LAYERED3
    from nma.params import ParamSpace as ParamSpace
    from nma.render.scene import preview_scene as preview_scene
    from nma.sources import get as source  # noqa: F401
    from nma.sources import read as read_values  # noqa: F401
    from nma.table import Tables as Tables
    from nma.table import tabulate as tabulate
    from nma.table.dataset import Dataset as Dataset
    from nma.table.dataset import Settings as Settings
    from nma.train.fit import fit as fit

_HOMES = {
    "Adapter": "nma.adapter",
    "shipped": "nma.adapter",
    "Dataset": "nma.table.dataset",
    "Settings": "nma.table.dataset",
    "NmaError": "nma.errors",
    "evaluate_adapter": "nma.evaluate:evaluate",
    "tabulate_adapter": "nma.evaluate",
    "compare_images": "nma.images.metrics",
    "compare_values": "nma.evaluate.pairs:compare",
    "load_material": "nma.materials:load",
    "material_names": "nma.materials:names",
    "LAYERED3": "nma.params",
    "ParamSpace": "nma.params",
    "preview_scene": "nma.render.scene",
    "source": "nma.sources:get",
    "read_values": "nma.sources:read",
    "AdapterValues": "nma.adapter.values",
    "Library": "nma.adapter.library",
    "Runtime": "nma.native.runtime",
    "Tables": "nma.table",
    "tabulate": "nma.table",
    "fit": "nma.train.fit",
}

__all__ = [*_HOMES, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'nma' has no attribute '{name}'")
    home, _, original = _HOMES[name].partition(":")
    value = getattr(import_module(home), original or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
