"""The functions, structures and constants of the target, as syntax trees.

The list of functions is sorted so that each function comes after all functions that it calls. The functions use only
assignments of expressions to names, arithmetic, comparisons, calls, access to the fields of structures, and one return
at the end, which every shading language has. Some functions, such as `spec_alpha`, return a tuple. A language without
tuples, such as GLSL, HLSL or WGSL, needs a structure for each of these functions. Any other construct raises an error
that names its file and line.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

from nma import microfacet
from nma.errors import NmaError
from nma.target import albedo, interface, plane, principled, sampling

STRUCTURES: tuple[type, ...] = (
    principled.Principled,
    principled.Geometry,
    principled.Terms,
    principled.Lobes,
    interface.Interface,
    interface.Crossing,
    albedo.Albedos,
    plane.Plane,
)
# In this list, a function comes after all functions that it calls. The method `of` of the structure `Plane` becomes the
# function `plane_of`.
FUNCTIONS: tuple[Callable, ...] = (
    microfacet.ggx_d,
    microfacet.smith_g1,
    microfacet.visible_normal_pdf,
    microfacet.reflect,
    microfacet.refract,
    microfacet.sample_visible_normal,
    microfacet.fresnel_dielectric,
    microfacet.fresnel_conductor,
    principled.schlick_weight,
    principled.masking_denominator,
    principled.geometry,
    principled.spec_alpha,
    principled.clearcoat_alpha,
    principled.specular_f0,
    principled.specular_eta,
    principled.dielectric_reflectance,
    principled.luminance_inverse,
    principled.microfacet_lobe,
    principled.gtr1_d,
    principled.diffuse_terms,
    principled.spec_fresnel,
    principled.faded,
    principled.eval_pdf_lobes,
    interface.cos_below,
    interface.refracted,
    interface.stretch,
    interface.shifted,
    interface.cos_shifted,
    interface.way_out,
    interface.crossing,
    interface.lobes_below,
    interface.eval_pdf_lobes_below,
    albedo.diffuse_albedo,
    albedo.unmasked_albedo,
    albedo.spec_albedo,
    albedo.clearcoat_albedo,
    albedo.lobe_albedos,
    albedo.interface_albedo,
    albedo.leaving,
    albedo.lobe_albedos_below,
    sampling.sample_diffuse,
    sampling.sample_spec,
    sampling.sample_clearcoat,
    interface.sample_below,
    plane.Plane.of,
    plane.Plane.enter,
    plane.Plane.leave,
)


class Unsupported(NmaError):
    """A Python construct that cannot be exported to other languages."""


@dataclass(frozen=True)
class Function:
    """A parsed function: its arguments (name, annotation), the annotation of its result, and its statements."""

    name: str
    doc: str
    arguments: list[tuple[str, str]]
    returns: str
    body: list[ast.stmt]
    module: ModuleType

    def unsupported(
        self, node: ast.AST, what: str, remedy: str = "write it with arithmetic and `ops`"
    ) -> Unsupported:
        """The error for a construct that cannot be exported. The message names the file and the line of the
        construct."""
        place = f"{self.module.__file__}:{getattr(node, 'lineno', '?')}"
        return Unsupported(f"{place}: {what} cannot be exported; {remedy}")


@cache
def functions() -> tuple[Function, ...]:
    """The syntax trees of all functions in `FUNCTIONS`."""
    return tuple(parsed(function) for function in FUNCTIONS)


@cache
def constants() -> dict[str, float]:
    """The names and the values of the global constants that the functions use."""
    found = {}
    for function in functions():
        for name in _names(function):
            value = getattr(function.module, name, None)
            if isinstance(value, int | float):
                found[name] = float(value)
    return found


def structures() -> Iterator[tuple[str, str, list[tuple[str, str]]]]:
    """Yields the name, the docstring and the fields (name, type) of every structure."""
    for structure in STRUCTURES:
        yield structure.__name__, inspect.getdoc(structure) or "", fields(structure)


def fields(structure: type) -> list[tuple[str, str]]:
    """The names and the types of a structure's fields."""
    hints = structure.__annotations__.items()
    return [(name, str(getattr(hint, "__forward_arg__", hint))) for name, hint in hints]


def _names(function: Function) -> list[str]:
    """All names in a function's statements, in order."""
    module = ast.Module(function.body, [])
    return [node.id for node in ast.walk(module) if isinstance(node, ast.Name)]


def parsed(function: Callable) -> Function:
    """Parses a function. The nodes of the syntax tree have the line numbers of the source file."""
    lines, first = inspect.getsourcelines(function)
    tree = ast.parse(textwrap.dedent("".join(lines))).body[0]
    ast.increment_lineno(tree, first - 1)
    module: Any = inspect.getmodule(function)
    assert isinstance(tree, ast.FunctionDef)
    owner, _, _ = function.__qualname__.rpartition(".")
    name = f"{owner.lower()}_{tree.name}" if owner else tree.name
    # Because `self` has no annotation, it gets the name of its class as its type.
    arguments = [(a.arg, ast.unparse(a.annotation) if a.annotation else owner) for a in tree.args.args]
    body = tree.body[1:] if ast.get_docstring(tree) else tree.body
    returns = ast.unparse(tree.returns) if tree.returns else ""
    return Function(name, ast.get_docstring(tree) or "", arguments, returns, body, module)
