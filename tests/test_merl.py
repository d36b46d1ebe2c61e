"""MERL files: their layout, their evaluation, and how other sources are written as MERL files."""

import math
import re
import struct
from dataclasses import replace

import numpy as np
import pytest
from adapter_cases import random_adapter
from source_cases import LAMBERT, Formula, direction, lanes, numbers, pairs

from nma import materials, ops, sources
from nma.adapter import Adapter
from nma.adapter.values import AdapterValues
from nma.errors import SourceError
from nma.ops import Vec3
from nma.sources import half_difference, merl, read
from nma.sources.merl import BYTES, SCALE, SHAPE, Merl
from nma.sources.nbrdf import WEIGHTS
from nma.table import Tables


def at(h, d, p):
    """Returns the directions (light, view) at a position in the grid of a MERL file.

    `h`, `d` and `p` are the indices of theta_h, theta_d and phi_d, and need not be integers.
    """
    theta_h, theta_d = (np.asarray(h) / 90) ** 2 * math.pi / 2, np.asarray(d) / 90 * math.pi / 2
    light, view = half_difference.directions(theta_h, theta_d, np.asarray(p) / 180 * math.pi)
    return light, view


def f_of(source, light, view):
    """Returns f (n, 3) of a source, for directions as NumPy arrays."""
    light, view = Vec3(*lanes(*light)), Vec3(*lanes(*view))
    return numbers(source.eval(view, light)) / light.z.numpy()[:, None]


@pytest.fixture(scope="module")
def planes():
    """The three colour planes of a MERL file with random entries, a tenth of which are marked as not measured."""
    rng = np.random.default_rng(0)
    values = rng.random((3, *SHAPE)) + 0.1
    values[:, rng.random(SHAPE) < 0.1] = -1.0
    return values


def inner_cells(n=2000, seed=1):
    """Returns random cells of the MERL grid. In the middle of each cell, both directions are above the horizon."""
    rng = np.random.default_rng(seed)
    h, d, p = rng.integers(0, 60, n), rng.integers(0, 40, n), rng.integers(0, 180, n)
    light, view = at(h + 0.5, d + 0.5, p + 0.5)
    above = (light.z > 0.05) & (view.z > 0.05)
    return h[above], d[above], p[above]


def test_half_and_difference_angles_give_the_directions_back():
    rng = np.random.default_rng(2)
    theta_h, theta_d = rng.uniform(0.01, 0.7, (2, 1000))
    phi_d = rng.uniform(-math.pi, math.pi, 1000)
    light, view = half_difference.directions(theta_h, theta_d, phi_d)
    for w in (light, view):
        np.testing.assert_allclose(ops.dot(w, w), 1.0)
    np.testing.assert_allclose(half_difference.angles(light, view), (theta_h, theta_d, phi_d), atol=1e-12)


def test_turning_both_directions_changes_no_angle_and_swapping_them_turns_the_azimuth():
    rng = np.random.default_rng(3)
    light, view = half_difference.directions(*rng.uniform(0.05, 0.7, (2, 500)), rng.uniform(-3.0, 0.0, 500))
    before = half_difference.angles(light, view)
    c, s = math.cos(2.0), math.sin(2.0)
    turned = [Vec3(c * w.x - s * w.y, s * w.x + c * w.y, w.z) for w in (light, view)]
    np.testing.assert_allclose(half_difference.angles(*turned), before, atol=1e-12)
    swapped = half_difference.angles(view, light)
    np.testing.assert_allclose(swapped, (before[0], before[1], before[2] + math.pi), atol=1e-12)


def test_a_vertical_half_vector_is_harmless():
    up = Vec3(np.zeros(1), np.zeros(1), np.ones(1))
    h, d = half_difference.half_difference(up, up)
    np.testing.assert_allclose((*h, *d), (*up, *up), atol=1e-12)
    assert np.isfinite(half_difference.angles(up, -up)).all()


def test_a_file_of_full_size_comes_back(planes, tmp_path):
    path = tmp_path / "new" / "random.binary"
    Merl(planes).save(path)
    assert path.stat().st_size == BYTES == 34_992_012
    np.testing.assert_array_equal(merl.read(path), planes)
    assert [p.name for p in path.parent.iterdir()] == ["random.binary"]
    assert read(path).name == "random"


def test_the_layout_is_merls(planes, tmp_path):
    """A MERL file begins with the three dimensions of the grid, and all entries follow.

    In the order of the entries, the index of phi_d varies fastest, followed by theta_d and theta_h. The channel varies
    slowest.
    """
    path = tmp_path / "random.binary"
    Merl(planes).save(path)
    content = path.read_bytes()
    assert struct.unpack_from("<3i", content) == (90, 90, 180)
    for channel, h, d, p in ((0, 0, 0, 1), (0, 0, 1, 0), (1, 1, 0, 0), (2, 89, 88, 179)):
        entry = p + 180 * (d + 90 * (h + 90 * channel))
        assert struct.unpack_from("<d", content, 12 + 8 * entry)[0] == planes[channel, h, d, p]


def test_an_entry_is_the_value_in_the_middle_of_its_cell(planes):
    """In the middle of a cell, f is the cell's entry times the scale of the colour channel.

    The reader published with the MERL database returns the same f, although it rounds angles down to an entry instead
    of interpolating.
    """
    h, d, p = inner_cells()
    expected = (planes[:, h, d, p] * SCALE[:, None]).T
    measured = expected[:, 0] > 0
    source = Merl(planes)
    light, view = at(h + 0.5, d + 0.5, p + 0.5)
    # If light and view are swapped, f comes from the same entry, because the format is reciprocal.
    for found in (f_of(source, light, view), f_of(source, view, light)):
        error = np.abs(found[measured] / expected[measured] - 1.0)
        # The largest error is near the normal, where cells are too small for half vectors in single precision.
        assert np.median(error) < 1e-4
        assert error.max() < 0.05


def test_values_between_are_linear_in_each_coordinate():
    h, d, p = np.meshgrid(*[np.arange(n) + 0.5 for n in SHAPE], indexing="ij")
    plane = 1.0 + 0.1 * h + 0.05 * d + 0.01 * np.abs(p - 90.0)
    rng = np.random.default_rng(4)
    position = rng.uniform(1.0, 50.0, 500), rng.uniform(1.0, 40.0, 500), rng.uniform(1.0, 89.0, 500)
    found = f_of(Merl(np.stack([plane] * 3)), *at(*position))
    expected = 1.0 + 0.1 * position[0] + 0.05 * position[1] + 0.01 * (90.0 - position[2])
    np.testing.assert_allclose(found, expected[:, None] * SCALE, rtol=2e-4)


def test_the_azimuth_goes_round():
    """Values between the last and the first entry of phi_d are interpolated, because phi_d is periodic."""
    plane = np.zeros(SHAPE)
    plane[..., 0], plane[..., -1] = 3.0, 1.0
    found = f_of(
        Merl(np.stack([plane] * 3)), *at(np.full(3, 20.5), np.full(3, 20.5), np.array([0.0, 180.0, 359.99]))
    )
    np.testing.assert_allclose(found / SCALE, [[2.0] * 3, [2.0] * 3, [1.98] * 3], rtol=2e-2)


def test_what_was_not_measured_is_left_out():
    """A uniform material with missing entries stays uniform.

    The material is black at directions whose neighbouring entries are all missing.
    """
    rng = np.random.default_rng(5)
    uniform = np.where(rng.random(SHAPE) < 0.3, -0.5, 1500.0)
    uniform[40:] = -1.0
    source = Merl(np.stack([uniform] * 3))
    h, d, p = rng.uniform(0, 38, 2000), rng.uniform(0, 40, 2000), rng.uniform(0, 180, 2000)
    found = f_of(source, *at(h, d, p))
    seen = found[:, 0] > 0
    assert 0.98 < seen.mean() < 1.0
    np.testing.assert_allclose(found[seen], np.broadcast_to(SCALE * 1500.0, found[seen].shape), rtol=1e-5)
    assert (f_of(source, *at(np.full(9, 42.0), np.full(9, 5.0), np.arange(9.0))) == 0).all()


def test_below_the_horizon_it_is_black(planes):
    wi, wo = pairs(100)
    for pair in ((-wi, wo), (wi, -wo), (-wi, -wo)):
        assert (numbers(Merl(planes).eval(*pair)) == 0).all()
    assert (numbers(Merl(planes).eval(wi, -wi)) == 0).all()


def test_a_lambertian_surface_becomes_a_file_and_stays_one(tmp_path):
    path = tmp_path / "lambert.binary"
    Merl.of(LAMBERT).save(path)
    source = Merl.load(path)
    f = source.planes * SCALE[:, None, None, None]
    measured = (source.planes >= 0).all(axis=0)
    light, view = at(*np.meshgrid(*[np.arange(n) + 0.5 for n in SHAPE], indexing="ij"))
    np.testing.assert_array_equal(measured, (light.z > 1e-4) & (view.z > 1e-4))
    np.testing.assert_allclose(f[0][measured], 0.8 / math.pi, rtol=1e-4)
    assert (f[2][measured] == 0).all() and (source.planes[:, ~measured] < 0).all()
    wi, wo = pairs(2000, low=0.05)
    np.testing.assert_allclose(numbers(source.eval(wi, wo)), numbers(LAMBERT.eval(wi, wo)), rtol=1e-3)


def test_a_file_is_reciprocal_whatever_it_was_made_from():
    lopsided = Formula(lambda wi, wo: wo.z * (1.0 + wi.z))
    source = Merl.of(lopsided)
    wi, wo = pairs(2000, low=0.2)
    f, g = (
        numbers(source.eval(wi, wo)) / wo.z.numpy()[:, None],
        numbers(source.eval(wo, wi)) / wi.z.numpy()[:, None],
    )
    np.testing.assert_allclose(f, g, rtol=1e-3)
    expected = 1.0 + 0.5 * (wi.z + wo.z).numpy()
    np.testing.assert_allclose(f, np.broadcast_to(expected[:, None], f.shape), rtol=2e-3)


def test_an_anisotropic_source_is_refused():
    with pytest.raises(SourceError, match="brushed: .*anisotropic"):
        Merl.of(Formula(LAMBERT.formula, isotropic=False, name="brushed"))


def spoilt(value, where=slice(5, 6)):
    """Returns the bytes of a MERL file in which some entries are replaced by `value`."""
    entries = np.ones(3 * math.prod(SHAPE))
    entries[where] = value
    return struct.pack("<3i", *SHAPE) + entries.tobytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda: b"", "0 bytes are too short for a MERL file"),
        (lambda: b"\0" * 11, "11 bytes are too short for a MERL file"),
        (lambda: struct.pack("<3i", 90, 90, 360), r"dimensions are \(90, 90, 360\)"),
        (lambda: b"a text file, and no BRDF at all", "dimensions are"),
        (lambda: spoilt(1.0)[:-8], "truncated, 34,992,004 bytes instead of 34,992,012"),
        (lambda: spoilt(1.0) + b"\0", "too long, 34,992,013 bytes"),
        (lambda: spoilt(math.nan), r"entry \[0, 0, 5\] of red is not finite"),
        (lambda: spoilt(math.inf), "not finite"),
        (lambda: spoilt(-1.0, slice(None)), "every entry is negative"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path, content, message):
    path = tmp_path / "bad.binary"
    path.write_bytes(content())
    with pytest.raises(SourceError, match=message) as caught:
        Merl.load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    for path, message in (
        (tmp_path / "no.binary", "no such file; `nma data` says where"),
        (tmp_path, "cannot be read"),
    ):
        with pytest.raises(SourceError, match=message) as caught:
            Merl.load(path)
        assert str(path) in str(caught.value)


def test_planes_of_another_shape_are_refused():
    with pytest.raises(SourceError, match="planes have shape"):
        Merl(np.zeros((3, 90, 90, 360)))


def test_files_of_other_kinds_are_refused(tmp_path):
    with pytest.raises(SourceError, match=re.escape(", ".join(sources.FORMATS))):
        read(tmp_path / "material.mtl")


def test_near_the_mirror_direction_steps_are_fine():
    """The grid is uniform in the square root of theta_h, so it resolves a lobe that is half a degree wide."""
    narrow = Formula(lambda wi, wo: wo.z * ops.exp((ops.normalize(wi + wo).z - 1.0) * 2.0e4))
    source = Merl.of(narrow)
    mu = np.full(400, 0.7)
    tilt = np.linspace(-0.03, 0.03, 400)
    theta = np.arccos(0.7) + tilt
    wi, wo = direction(mu, np.zeros(400)), direction(np.cos(theta), np.full(400, math.pi))
    found, expected = numbers(source.eval(wi, wo)), numbers(narrow.eval(wi, wo))
    np.testing.assert_allclose(found, expected, atol=0.02 * expected.max())


# ---- The command -----------------------------------------------------------------------------------------------------

LACQUER = materials.load("gold-red-lacquer")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a BSDF, an adapter of a class, an adapter of a single material, NBRDF networks and a table."""
    folder = tmp_path_factory.mktemp("sources")
    (folder / "matte.xml").write_text('<bsdf version="3.0.0" type="diffuse"/>')
    (folder / "brushed.xml").write_text(
        '<bsdf version="3.0.0" type="principled"><float name="anisotropic" value=".9"/></bsdf>'
    )
    random_adapter(hidden="1x8").save(folder / "class.safetensors")
    single = random_adapter(hidden="1x8", name="direction")
    record = {"params": LACQUER.vector().tolist()}
    replace(single, training=record).save(folder / "single.safetensors")
    np.savez(folder / "networks.npz", names=np.array(["a"]), weights=np.zeros((1, WEIGHTS), np.float32))
    Tables(np.zeros((1, 0)), np.zeros((1, 2, 2, 2, 3)), np.ones(1, np.int64)).save(folder / "table.npz")
    return folder


@pytest.mark.parametrize(
    ("arguments", "values"),
    [
        (["matte.xml"], lambda: read("matte.xml")),
        (["networks.npz", "--material", "a"], lambda: read("networks.npz", "a")),
        (["single.safetensors"], lambda: AdapterValues(Adapter.load("single.safetensors"))),
        (
            ["gold-red-lacquer", "--adapter", "class.safetensors"],
            lambda: AdapterValues(Adapter.load("class.safetensors"), LACQUER.vector()),
        ),
    ],
)
def test_any_isotropic_material_is_written_by_a_command(
    nma, folder, tmp_path, monkeypatch, arguments, values
):
    monkeypatch.chdir(folder)
    path = tmp_path / "new" / "it.binary"
    code, out, err = nma("data", "merl", *arguments, "-o", path)
    assert (code, out) == (0, ""), err
    assert "75% of the entries above the horizon" in err
    np.testing.assert_array_equal(merl.read(path), Merl.of(values()).planes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["brushed.xml"], "this source is anisotropic"),
        (["table.npz"], "holds tables.*nma fit table.npz"),
        (["none.npz"], "no such file"),
        (["class.safetensors"], "class is an adapter of the whole class layered3; name a material"),
        (["gold-red-laquer"], "did you mean 'gold-red-lacquer'"),
        (["wet-nickel", "--adapter", "single.safetensors"], "was trained for a single material"),
    ],
)
def test_what_has_no_values_for_a_merl_file_is_one_line(
    nma, folder, tmp_path, monkeypatch, arguments, message
):
    monkeypatch.chdir(folder)
    code, out, err = nma("data", "merl", *arguments, "-o", tmp_path / "it.binary")
    assert (code, out) == (1, "")
    assert err.count("\n") == 1 and re.search(message, err), err
    assert not list(tmp_path.iterdir())


def test_a_merl_file_has_the_ending_of_one(nma, tmp_path):
    assert nma("data", "merl", "gold-red-lacquer", "-o", tmp_path / "it.bin")[0] == 2
