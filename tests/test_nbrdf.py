"""NBRDF networks: the layout of their weights, and their distance to the measurements that they were fitted to."""

import math

import numpy as np
import pytest
from source_cases import log_loss, numbers, pairs

from nma import ops
from nma.errors import SourceError
from nma.ops import Vec3
from nma.sources import nbrdf, read
from nma.sources.mitsuba_bsdf import measured
from nma.sources.nbrdf import Nbrdf

# The log loss of f cos(theta_o) between the network and the measurement of each material. The cosines of the pairs of
# directions are uniform in .05 .. 1.
CLOSENESS = {
    "cc_ibiza_sunset": 0.0037,
    "cg_sunflower": 0.0032,
    "colodur_napoli_4f": 0.0009,
    "paper_white": 0.0026,
}


@pytest.fixture
def merl_file(measurements):
    return measurements / "merl_nbrdf" / "merl_nbrdf_weights.npz"


@pytest.fixture
def rgl_file(measurements):
    return measurements / "rgl_nbrdf" / "rgl-isotropic_nbrdf_weights.npz"


def rotation(axis, angle):
    """Returns the matrix that rotates vectors about y or z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]] if axis == "y" else [[c, -s, 0], [s, c, 0], [0, 0, 1]])


def by_hand(weights, view, light):
    """Returns f for a pair of directions in double precision, by the steps that the networks' authors describe."""
    half = (view + light) / np.linalg.norm(view + light)
    theta_h, phi_h = math.acos(half[2]), math.atan2(half[1], half[0])
    difference = rotation("y", -theta_h) @ rotation("z", -phi_h) @ light
    x = np.array([math.sin(theta_h), 0.0, math.cos(theta_h), *difference])
    k1, b1, k2, b2, k3, b3 = np.split(weights.astype(np.float64), np.cumsum([126, 21, 441, 21, 63]))
    x = np.maximum(x @ k1.reshape(6, 21) + b1, 0.0)
    x = np.maximum(x @ k2.reshape(21, 21) + b2, 0.0)
    return np.maximum(np.exp(x @ k3.reshape(21, 3) + b3) - 1.0, 0.0)


def test_a_network_is_what_its_authors_describe(merl_file):
    names, weights = nbrdf.read(merl_file)
    wi, wo = pairs(50, low=0.1)
    for material in ("alum-bronze", "chrome", "yellow-plastic"):
        found = numbers(Nbrdf.load(merl_file, material).eval(wi, wo))
        row = weights[names.index(material)]
        views, lights = (np.stack([c.numpy() for c in w], axis=-1).astype(np.float64) for w in (wi, wo))
        expected = [by_hand(row, v, l) * l[2] for v, l in zip(views, lights, strict=True)]
        np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("material", CLOSENESS)
def test_networks_come_close_to_the_measurements_they_were_fitted_to(measurements, rgl_file, material):
    """The log loss between a network and its RGL measurement is the value in `CLOSENESS`, within 6 %."""
    network = Nbrdf.load(rgl_file, f"{material}_rgb")
    source = measured(measurements / "rgl" / f"{material}_rgb.bsdf")
    wi, wo = pairs(200_000, 1, low=0.05)
    reference = numbers(source.eval(wi, wo))
    loss = log_loss(numbers(network.eval(wi, wo)), reference)
    assert loss == pytest.approx(CLOSENESS[material], rel=0.06)
    # The loss is larger if the difference vector is computed from the view direction in place of the light direction.
    swapped = numbers(network.eval(wo, wi)) * (wo.z / wi.z).numpy()[:, None]
    assert log_loss(swapped, reference) > 1.2 * loss


def test_networks_are_isotropic_and_black_below_the_horizon(merl_file):
    source = Nbrdf.load(merl_file, "blue-acrylic")
    wi, wo = pairs(500, low=0.05)
    c, s = math.cos(1.0), math.sin(1.0)
    turned = [Vec3(c * w.x - s * w.y, s * w.x + c * w.y, w.z) for w in (wi, wo)]
    np.testing.assert_allclose(
        numbers(source.eval(*turned)), numbers(source.eval(wi, wo)), rtol=1e-2, atol=1e-4
    )
    for pair in ((wi, -wo), (-wi, wo), (-wi, -wo), (wi, -wi)):
        assert (numbers(source.eval(*pair)) == 0).all()
    up = Vec3(0.0 * wi.z, 0.0 * wi.z, 0.0 * wi.z + 1.0)
    assert np.isfinite(numbers(source.eval(up, up))).all()
    assert (numbers(source.eval(wi, ops.normalize(wi))) >= 0).all()


def test_texts_never_take_a_network_for_a_measurement(merl_file, rgl_file):
    assert read(merl_file, "chrome").name == "NBRDF-MERL chrome"
    assert read(rgl_file, "spectralon_rgb").name == "NBRDF-RGL spectralon_rgb"
    assert nbrdf.kind(["wood", "stone"]) == "NBRDF"


def test_a_material_that_is_not_there_is_refused(merl_file):
    with pytest.raises(
        SourceError, match="no material 'crome' among its 100 materials; did you mean 'chrome'"
    ):
        read(merl_file, "crome")
    with pytest.raises(SourceError, match="no material 'zzz' among its 100 materials; it has alum-bronze"):
        read(merl_file, "zzz")
    with pytest.raises(SourceError, match=r"holds 100 material\(s\); say which: alum-bronze, "):
        read(merl_file)


NAMES, WEIGHTS = np.array(["a", "b"]), np.zeros((2, 675), np.float32)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"weights": WEIGHTS}, "not a weights file of NBRDF networks"),
        ({"names": NAMES}, "not a weights file of NBRDF networks"),
        ({"names": NAMES, "weights": WEIGHTS[:1]}, r"names \(2,\) and weights \(1, 675\)"),
        ({"names": NAMES, "weights": WEIGHTS[:, :-1]}, r"weights \(2, 674\)"),
        ({"names": np.zeros(2), "weights": WEIGHTS}, "are not"),
        ({"names": NAMES, "weights": WEIGHTS.astype(int)}, "not finite numbers"),
        ({"names": NAMES, "weights": WEIGHTS + np.nan}, "not finite numbers"),
    ],
)
def test_a_malformed_weights_file_is_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "bad.npz", **arrays)
    assert_refused(tmp_path / "bad.npz", message)


def test_a_missing_or_damaged_weights_file_is_refused(tmp_path):
    path = tmp_path / "weights.npz"
    assert_refused(path, "no such file; `nma data` says where")
    np.savez(path, names=NAMES, weights=WEIGHTS)
    assert Nbrdf.load(path, "b").name == "NBRDF b"
    whole = path.read_bytes()
    for content in (b"", b"text", whole[: len(whole) // 2]):
        path.write_bytes(content)
        assert_refused(path, "not a weights file")


def test_other_numbers_of_weights_are_refused():
    with pytest.raises(SourceError, match="675 weights"):
        Nbrdf(np.zeros(674))


def assert_refused(path, message):
    with pytest.raises(SourceError, match=message) as caught:
        Nbrdf.load(path, "a")
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
