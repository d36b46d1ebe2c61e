"""Any BSDF of Mitsuba 3 as a source: from a dictionary, from XML, or from a measured material of RGL's database.

A source includes only the light that the front side reflects. Transmitted light, and the light that the back of a
two-sided BSDF reflects, are left out. A perfectly specular reflection has no value at a pair of directions, so a BSDF
with such a reflection is rejected.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from nma.errors import ParamError, SourceError, one_line
from nma.jit import dr
from nma.ops import Color, Vec3
from nma.sources import rgl
from nma.sources.base import direction
from nma.sources.files import Format

# A BSDF is tested for isotropy at `_PAIRS` pairs of directions. Relative changes up to `_ROUNDING` are taken for
# rounding errors.
_PAIRS = 512
_ROUNDING = 1e-3
# A direction whose cosine is below `_MIN_COS` is raised to the cosine `_MIN_COS`. With smaller cosines, Mitsuba's
# measured and rough BSDFs would return NaN for two opposite directions at the horizon, whose half vector is imprecise
# in single precision.
_MIN_COS = 1e-6


class MitsubaBsdf:
    """A Mitsuba BSDF (`Values`), which can be used only in the Mitsuba variant in which it was made.

    If no variant is set yet, the constructor sets `cuda_ad_rgb` on a machine with a GPU, else `llvm_ad_rgb`. `bsdf` is
    an instance of `mi.BSDF`. `uv` is the point at which the BSDF's textures are read. `isotropic` tells whether the
    BSDF is isotropic; if `isotropic` is None, the constructor tests the BSDF with rotated pairs of directions. Raises
    `SourceError` for a BSDF with a perfectly specular reflection, and `ParamError` if the variant is not vectorised or
    not RGB.
    """

    def __init__(
        self,
        bsdf: Any,
        name: str = "BSDF",
        *,
        uv: tuple[float, float] = (0.5, 0.5),
        isotropic: bool | None = None,
    ):
        mi = choose_variant()
        if mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaReflection):
            raise SourceError(
                f"{name}: reflects like a perfect mirror, which has no value at a pair of directions; "
                "make the material slightly rough"
            )
        self.bsdf, self.name, self._uv, self._variant = bsdf, name, uv, mi.variant()
        self.isotropic = self._is_isotropic() if isotropic is None else isotropic

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f cos(theta_o) [1/sr]."""
        import mitsuba

        mi: Any = mitsuba
        if mi.variant() != self._variant:
            raise ParamError(
                f"{self.name} was made in {self._variant}, but Mitsuba's variant is now {mi.variant()}; "
                "make the source again"
            )
        with dr.suspend_grad():
            active = mi.Bool((wi.z > 0) & (wo.z > 0))
            lifted_wi, lifted_wo = (mi.Vector3f(w.x, w.y, dr.maximum(w.z, _MIN_COS)) for w in (wi, wo))
            si = _interaction(mi, lifted_wi, self._uv)
            value = self.bsdf.eval(mi.BSDFContext(), si, lifted_wo, active)
            value = dr.select(active, value, 0.0)
            plain = [dr.detach(c, preserve_type=False) for c in value]
        return Color(*(type(wi.z)(c) for c in plain))

    def _is_isotropic(self) -> bool:
        """Whether values stay the same when both directions are rotated about the normal by the same angle."""
        rng = np.random.default_rng(0)
        mu_i, mu_o = rng.uniform(0.05, 0.95, (2, _PAIRS))
        phi_i, phi_o, turn = rng.uniform(0.0, 2.0 * np.pi, (3, _PAIRS))
        sets = [self.eval(direction(mu_i, phi_i + a), direction(mu_o, phi_o + a)) for a in (0.0, turn)]
        one, other = (np.stack([c.numpy() for c in value]) for value in sets)
        return bool(np.abs(one - other).sum() <= _ROUNDING * np.abs(one).sum())


def from_dict(description: Mapping[str, Any], name: str | None = None, **options: Any) -> MitsubaBsdf:
    """The BSDF of a dictionary for `mi.load_dict`. The `options` are those of `MitsubaBsdf`.

    Raises `SourceError` if Mitsuba cannot load the dictionary, or if the dictionary names a damaged file of a measured
    material.
    """
    for filename in _measured_files(description):
        rgl.read(filename)
    label = name or f"BSDF '{description.get('type')}'"
    return _made(lambda mi: mi.load_dict(dict(description)), label, options)


def from_xml(path: str | Path, **options: Any) -> MitsubaBsdf:
    """The BSDF of an XML file whose outermost element is <bsdf>. The `options` are those of `MitsubaBsdf`.

    Raises `SourceError` if there is no such file, and for the same faults as `from_dict`.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise SourceError(f"{path}: no such file")
    for filename in _measured_in_xml(path.read_bytes()):
        # File names in the XML are relative to the folder of the XML file.
        rgl.read(path.parent / filename)
    return _made(lambda mi: mi.load_file(str(path)), str(path), options)


def from_string(text: str, **options: Any) -> MitsubaBsdf:
    """The BSDF of an XML string, '<bsdf version="3.0.0" type="...">...'. The `options` are those of `MitsubaBsdf`."""
    for filename in _measured_in_xml(text.encode()):
        rgl.read(filename)
    return _made(lambda mi: mi.load_string(text), "XML", options)


def measured(path: str | Path, **options: Any) -> MitsubaBsdf:
    """A material of RGL's database, isotropic or anisotropic, in RGB. The `options` are those of `MitsubaBsdf`.

    Raises `SourceError` if the file is missing, damaged or spectral.
    """
    # Mitsuba treats a material as isotropic if its file has at most two azimuths of incidence.
    isotropic = len(rgl.read(path)["phi_i"]) <= 2
    description = {"type": "measured", "filename": str(path)}
    options = {"isotropic": isotropic} | options
    return _made(lambda mi: mi.load_dict(description), Path(path).stem, options)


def _measured_files(description: Mapping[str, Any]) -> Iterator[str]:
    """The file names of all measured materials in a dictionary, nested ones included."""
    if description.get("type") == "measured":
        yield str(description.get("filename"))
    for value in description.values():
        if isinstance(value, Mapping):
            yield from _measured_files(value)


def _measured_in_xml(text: bytes) -> list[str]:
    """The file names of all measured materials in an XML text.

    A text that does not parse gives an empty list, since Mitsuba reports the fault when it loads the text.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return []
    names = root.findall(".//bsdf[@type='measured']/string[@name='filename']")
    if root.get("type") == "measured":
        names += root.findall("string[@name='filename']")
    return [name.get("value", "") for name in names]


def choose_variant() -> Any:
    """The module `mitsuba` in a vectorised RGB variant. If no variant is set, sets the variant of Dr.Jit's backend."""
    import mitsuba

    mi: Any = mitsuba  # the type is Any, because Mitsuba's types change with the variant
    if mi.variant() is None:
        mi.set_variant("cuda_ad_rgb" if dr.has_backend(dr.JitBackend.CUDA) else "llvm_ad_rgb")
    if not mi.variant().endswith("_ad_rgb"):
        raise ParamError(
            f"sources evaluate BSDFs in the variants llvm_ad_rgb and cuda_ad_rgb, not in {mi.variant()}; call "
            "mi.set_variant('llvm_ad_rgb') first"
        )
    return mi


def _made(load: Callable[[Any], Any], name: str, options: Mapping[str, Any]) -> MitsubaBsdf:
    """The BSDF that `load(mi)` returns, as a source. Raises `SourceError` if the call fails or returns no BSDF."""
    mi = choose_variant()
    try:
        bsdf = load(mi)
    except RuntimeError as e:
        raise SourceError(f"{name}: {one_line(str(e))}") from None
    if not isinstance(bsdf, mi.BSDF):
        found = type(bsdf).__name__
        raise SourceError(f"{name}: holds a {found}, not a BSDF; the outermost element must be <bsdf>")
    return MitsubaBsdf(bsdf, name, **options)


def _interaction(mi: Any, wi: Any, uv: tuple[float, float]) -> Any:
    """A point on a flat surface, seen from `wi`, with a shading frame, which bump and normal maps need."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wi))
    si.wi = wi
    si.uv = mi.Point2f(*uv)
    si.n = mi.Normal3f(0.0, 0.0, 1.0)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0.0, 0.0, 1.0))
    si.dp_du, si.dp_dv = mi.Vector3f(1.0, 0.0, 0.0), mi.Vector3f(0.0, 1.0, 0.0)
    return si


def _identify(path: Path) -> str:
    rgl.read(path)
    return "RGL"


MEASURED = Format("RGL", measured, measurements=(rgl.RGL,), identify=_identify)
XML = Format("Mitsuba", from_xml)
