"""Mitsuba's BSDFs as sources, including the measured materials of RGL and their files."""

import math
import shutil
import struct

import numpy as np
import pytest
from source_cases import lanes, numbers, pairs

from nma import ops
from nma.errors import ParamError, SourceError
from nma.jit import dr
from nma.microfacet import ggx_d, smith_g1
from nma.ops import Vec3
from nma.sources import mitsuba_bsdf, read, rgl
from nma.sources.mitsuba_bsdf import from_dict, from_string, from_xml, measured

import mitsuba as mi  # isort: skip

MATERIALS = ("cc_ibiza_sunset", "cg_sunflower", "colodur_napoli_4f", "paper_white")
KINDS = {
    np.dtype(np.uint8): 1,
    np.dtype(np.uint32): 5,
    np.dtype(np.uint64): 7,
    np.dtype(np.float32): 10,
    np.dtype(np.float64): 11,
}
DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.4, 0.1]}}
MIRROR = {"type": "roughconductor", "material": "none", "distribution": "ggx"}
XML = '<bsdf version="3.0.0" type="diffuse"><rgb name="reflectance" value=".8 .4 .1"/></bsdf>'


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")
    yield
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def bsdf_file(measurements):
    return measurements / "rgl" / "paper_white_rgb.bsdf"


def write_tensors(path, fields):
    """Writes a tensor file with the given arrays."""
    at = 18 + sum(13 + len(name) + 8 * array.ndim for name, array in fields.items())
    header, data = b"tensor_file\0" + struct.pack("<BBI", 1, 0, len(fields)), b""
    for name, array in fields.items():
        offset = at + len(data)
        header += struct.pack("<H", len(name)) + name.encode()
        header += struct.pack(f"<HBQ{array.ndim}Q", array.ndim, KINDS[array.dtype], offset, *array.shape)
        data += array.tobytes()
    path.write_bytes(header + data)


def assert_lambertian(source):
    wi, wo = pairs(1000)
    expected = np.outer(wo.z.numpy(), [0.8, 0.4, 0.1]) / math.pi
    np.testing.assert_allclose(numbers(source.eval(wi, wo)), expected, rtol=1e-5)


def test_a_diffuse_bsdf_from_a_dictionary_a_file_and_a_fragment(tmp_path):
    path = tmp_path / "diffuse.xml"
    path.write_text(XML)
    for source in (from_dict(DIFFUSE), from_string(XML), from_xml(path), read(path)):
        assert source.isotropic
        assert_lambertian(source)


@pytest.mark.parametrize("alphas", ((0.01, 0.01), (0.2, 0.2), (0.1, 0.4)))
def test_a_rough_mirror_has_the_value_of_its_formula(alphas):
    """The value of a rough mirror is given by eq. 20 of Walter 2007, with a Fresnel term of 1."""
    source = from_dict(MIRROR | {"alpha_u": alphas[0], "alpha_v": alphas[1]})
    wi, wo = pairs(2000, low=0.05)
    m = ops.normalize(wi + wo)
    expected = ggx_d(m, *alphas) * smith_g1(wi, *alphas) * smith_g1(wo, *alphas) / (4.0 * wi.z)
    np.testing.assert_allclose(numbers(source.eval(wi, wo))[:, 0], expected.numpy(), rtol=1e-3)
    assert source.isotropic == (alphas[0] == alphas[1])


@pytest.mark.parametrize(
    ("bsdf", "isotropic"),
    [
        (
            {"type": "principled", "roughness": 0.2, "base_color": {"type": "rgb", "value": [0.5, 0.2, 0.1]}},
            True,
        ),
        ({"type": "principled", "roughness": 0.2, "metallic": 1.0, "anisotropic": 0.8}, False),
        ({"type": "roughplastic", "alpha": 0.001}, True),
        (MIRROR | {"alpha": 0.001}, True),
        (MIRROR | {"alpha_u": 0.001, "alpha_v": 0.0012}, False),
        ({"type": "twosided", "bsdf": DIFFUSE}, True),
        ({"type": "blendbsdf", "weight": 0.3, "a": DIFFUSE, "b": MIRROR | {"alpha": 0.3}}, True),
    ],
)
def test_whether_a_bsdf_is_isotropic_is_found_out(bsdf, isotropic):
    assert from_dict(bsdf).isotropic == isotropic
    assert from_dict(bsdf, isotropic=not isotropic).isotropic != isotropic


@pytest.mark.parametrize(
    "bsdf",
    ({"type": "roughdielectric", "alpha": 0.5, "distribution": "ggx"}, {"type": "twosided", "bsdf": DIFFUSE}),
)
def test_only_what_the_front_reflects_counts(bsdf):
    source = from_dict(bsdf)
    wi, wo = pairs(500, low=0.1)
    assert (numbers(source.eval(wi, wo)) > 0).all()
    for pair in ((wi, -wo), (-wi, wo), (-wi, -wo)):
        assert (numbers(source.eval(*pair)) == 0).all()


def test_textures_are_looked_up_where_asked():
    checkerboard = {"type": "checkerboard", "color0": {"type": "rgb", "value": 0.0}}
    bsdf = {"type": "diffuse", "reflectance": checkerboard | {"color1": {"type": "rgb", "value": 1.0}}}
    wi, wo = pairs(10)
    dark, bright = (numbers(from_dict(bsdf, uv=uv).eval(wi, wo)) for uv in ((0.25, 0.25), (0.75, 0.25)))
    assert (dark == 0).all() and (bright > 0).all()


def test_lanes_keep_their_type():
    """Values have the same array type as the directions: Dr.Jit's plain type, or Mitsuba's differentiable type."""
    wi, wo = pairs(10)
    source = from_dict(DIFFUSE)
    there = source.eval(Vec3(*map(mi.Float, wi)), Vec3(*map(mi.Float, wo)))
    assert [type(c) for c in there] == [mi.Float] * 3
    assert [type(c) for c in source.eval(wi, wo)] == [dr.auto.Float] * 3
    np.testing.assert_array_equal(numbers(there), numbers(source.eval(wi, wo)))


@pytest.mark.parametrize("kind", ("conductor", "dielectric", "plastic", "thindielectric"))
def test_perfect_mirrors_are_refused(kind):
    with pytest.raises(SourceError, match=f"'{kind}': reflects like a perfect mirror"):
        from_dict({"type": kind})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (XML.replace("diffuse", "difuse"), 'Plugin "difuse" not found'),
        (XML.replace("</bsdf>", ""), "tags mismatch"),
        (XML.replace(' version="3.0.0"', ""), "(?i)missing version"),
        ('<scene version="3.0.0"><bsdf type="diffuse"/></scene>', "holds a Scene, not a BSDF"),
        ("", "XML"),
    ],
)
def test_what_mitsuba_cannot_load_is_one_line(tmp_path, text, message):
    path = tmp_path / "bad.xml"
    path.write_text(text)
    for load in (lambda: from_string(text), lambda: from_xml(path)):
        with pytest.raises(SourceError, match=message) as caught:
            load()
        assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_missing_xml_file_is_refused(tmp_path):
    with pytest.raises(SourceError, match=r"no\.xml: no such file"):
        from_xml(tmp_path / "no.xml")


def test_variants_that_cannot_serve_are_refused():
    source = from_dict(DIFFUSE)
    mi.set_variant("scalar_rgb")
    with pytest.raises(ParamError, match="not in scalar_rgb; call"):
        from_dict(DIFFUSE)
    with pytest.raises(ParamError, match="made in llvm_ad_rgb, but Mitsuba's variant is now scalar_rgb"):
        source.eval(*pairs(2))


def nodes(fields, k=0):
    """Returns (wi, wo, f cos(theta_o)) at the nodes of a material's grid, for the azimuth of incidence with index k.

    The nodes are the points of the grid, warped by the distribution of visible normals. The value at a node is the
    grid's entry, times the distribution of normals, divided by four times the projected area (Dupuy and Jakob 2018,
    section 4).
    """
    phi, theta, size = float(fields["phi_i"][k]), fields["theta_i"], fields["rgb"].shape[-1]
    inner = np.arange(1, size - 1)
    n, y, x = (i.ravel() for i in np.meshgrid(np.arange(1, len(theta) - 1), inner, inner, indexing="ij"))
    warp = mi.MarginalContinuous2D2(fields["vndf"].copy(), [fields["phi_i"].tolist(), theta.tolist()])
    square = mi.Point2f(x / (size - 1), y / (size - 1))
    u = warp.sample(square, [mi.Float(phi), mi.Float(theta[n])])[0].numpy()
    theta_m, phi_m = u[0] ** 2 * math.pi / 2, (2 * u[1] - 1) * math.pi
    m = Vec3(np.sin(theta_m) * np.cos(phi_m), np.sin(theta_m) * np.sin(phi_m), np.cos(theta_m))
    sin = np.sin(theta[n])
    wi = Vec3(sin * math.cos(phi), sin * math.sin(phi), np.cos(theta[n]))
    rows = np.linspace(0.0, 1.0, fields["ndf"].shape[-1])
    ndf = np.interp(u[0], rows, fields["ndf"][0])
    sigma = np.interp(np.sqrt(theta[n] * 2 / math.pi), rows, fields["sigma"][0])
    value = fields["rgb"][k, n, :, y, x] * (ndf / (4 * sigma))[:, None]
    return wi, m * (2.0 * ops.dot(wi, m)) - wi, value


def assert_values_of_nodes(source, fields, k=0):
    wi, wo, expected = nodes(fields, k)
    above = wo.z > 0.05
    assert above.mean() > 0.3
    error = np.abs(numbers(source.eval(Vec3(*lanes(*wi)), Vec3(*lanes(*wo)))) - expected)[above]
    # Where the warp is steep, its inversion in single precision loses digits.
    assert np.quantile(error, 0.99) < 1e-3 * expected[above].mean()


@pytest.mark.parametrize("material", MATERIALS)
def test_a_measured_material_has_the_values_of_its_file(measurements, material):
    path = measurements / "rgl" / f"{material}_rgb.bsdf"
    source = measured(path)
    assert source.isotropic and source.name == f"{material}_rgb"
    assert_values_of_nodes(source, rgl.read(path))


def test_a_material_with_azimuths_of_incidence_is_anisotropic(bsdf_file, tmp_path):
    """The test makes an isotropic material anisotropic by changing its brightness with the azimuth of incidence."""
    fields, azimuths = rgl.read(bsdf_file), np.linspace(-math.pi, math.pi, 5).astype(np.float32)
    tiled = {name: np.repeat(fields[name], 5, axis=0) for name in ("vndf", "luminance", "rgb")}
    tiled["rgb"] = tiled["rgb"] * np.array([1, 2, 3, 4, 1], np.float32)[:, None, None, None, None]
    path = tmp_path / "brushed_rgb.bsdf"
    write_tensors(path, fields | tiled | {"phi_i": azimuths})
    source = measured(path)
    assert not source.isotropic and not source._is_isotropic()
    for k in (1, 2, 3):
        assert_values_of_nodes(source, rgl.read(path), k)


def changed(fields, **others):
    """Returns `fields` with replacements from `others`. A field that is None in `others` is left out."""
    return {name: array for name, array in (fields | others).items() if array is not None}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rgb": None}, "field 'rgb' is missing"),
        ({"vndf": None}, "field 'vndf' is missing"),
        (
            {"rgb": None, "spectra": np.zeros((1, 8, 4, 2, 2), np.float32)},
            "holds spectra; choose .*_rgb.bsdf",
        ),
        ({"theta_i": np.zeros(7, np.float32)}, r"field 'vndf' has shape \(1, 8,"),
        ({"ndf": np.zeros(128, np.float32)}, "field 'ndf' has shape .*, but must have 2 dimensions"),
        ({"sigma": np.full((2, 128), np.nan, np.float32)}, "field 'sigma' has values that are not finite"),
        ({"theta_i": np.linspace(1.5, 0.0, 8, dtype=np.float32)}, "field 'theta_i' does not ascend"),
        ({"theta_i": np.full(8, 0.5, np.float32)}, "field 'theta_i' does not ascend"),
        ({"theta_i": np.linspace(0.0, 90.0, 8, dtype=np.float32)}, r"does not ascend within 0 \.\. 1\.571"),
        ({"phi_i": np.array([1e6], np.float32)}, "field 'phi_i' does not ascend within"),
    ],
)
def test_a_material_without_its_fields_is_refused(bsdf_file, tmp_path, change, message):
    path = tmp_path / "bad_rgb.bsdf"
    write_tensors(path, changed(rgl.read(bsdf_file), **change))
    assert_refused(path, message)


@pytest.mark.parametrize(
    ("cut", "message"),
    [
        (lambda content: b"", "empty"),
        (lambda content: b"not a material", "not a tensor file"),
        (lambda content: content[:15], "truncated or damaged"),
        (lambda content: content[:300], "truncated or damaged"),
        (lambda content: content[:-1024], "truncated or damaged"),
        (lambda content: content[: len(content) // 2], "truncated or damaged"),
        (lambda content: content[:12] + b"\2" + content[13:], r"version 2\.0"),
        (lambda content: content[:29] + b"\xff" + content[30:], r"field 'version' has the unknown type 255"),
    ],
)
def test_a_damaged_material_is_refused(bsdf_file, tmp_path, cut, message):
    path = tmp_path / "bad_rgb.bsdf"
    path.write_bytes(cut(bsdf_file.read_bytes()))
    assert_refused(path, message)


def test_a_missing_material_is_refused(tmp_path):
    assert_refused(tmp_path / "no_rgb.bsdf", "no such file; `nma data` says where")
    assert_refused(tmp_path, "cannot be read")


def assert_refused(path, message):
    """Asserts that every function that reads the file raises an error of one line that names the file."""
    nested = {"type": "twosided", "bsdf": {"type": "measured", "filename": str(path)}}
    for load in (lambda: measured(path), lambda: from_dict(nested)):
        with pytest.raises(SourceError, match=message) as caught:
            load()
        assert str(caught.value).startswith(str(path))
        assert "\n" not in str(caught.value)


def test_a_measured_material_in_xml_lies_beside_it(bsdf_file, tmp_path):
    shutil.copy(bsdf_file, tmp_path / "paper.bsdf")
    inner = '<bsdf type="measured"><string name="filename" value="paper.bsdf"/></bsdf>'
    path = tmp_path / "paper.xml"
    path.write_text(f'<bsdf version="3.0.0" type="twosided">{inner}</bsdf>')
    wi, wo = pairs(100)
    found, expected = (numbers(s.eval(wi, wo)) for s in (from_xml(path), measured(bsdf_file)))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
    (tmp_path / "paper.bsdf").write_bytes(bsdf_file.read_bytes()[:-1000])
    with pytest.raises(SourceError, match="truncated or damaged"):
        from_xml(path)


def test_without_a_variant_one_is_chosen(monkeypatch):
    chosen = []
    monkeypatch.setattr(mi, "variant", lambda: chosen[-1] if chosen else None)
    monkeypatch.setattr(mi, "set_variant", chosen.append)
    mitsuba_bsdf.choose_variant()
    assert chosen in (["llvm_ad_rgb"], ["cuda_ad_rgb"])
