"""Every class that is simulated, and every format of files with BRDF values, gives an appearance that is possible.

The tests loop over `CLASSES` and `FORMATS` of nma/sources, so they also test a new class and a new format.
"""

import numpy as np
import pytest
from source_cases import LAMBERT, Formula, direction, lanes, numbers

from nma import sources
from nma.jit import dr
from nma.ops import Color
from nma.sources.base import walk
from nma.sources.layered import Layered3
from nma.sources.merl import Merl
from nma.sources.nbrdf import WEIGHTS

ROUGH = '<bsdf version="3.0.0" type="roughplastic"><float name="alpha" value="0.4"/></bsdf>'


def networks(path):
    weights = np.random.default_rng(0).normal(size=(1, WEIGHTS)).astype(np.float32) * 0.1
    np.savez(path, names=np.array(["grey"]), weights=weights)


# For each format, the function that writes a file of a rough material. A format that the tests cannot write has the
# name of a file in the folder of measured materials.
EXAMPLES = {
    ".binary": lambda path: Merl.of(LAMBERT).save(path),
    ".bsdf": "rgl/paper_white_rgb.bsdf",
    ".xml": lambda path: path.write_text(ROUGH),
    ".npz": networks,
}


def check_values(source):
    """Values are finite and 0 below the horizon, and a material that says that it is isotropic is isotropic.

    The mean albedo is from 0 to 1.05. A failure means that a training on the source fails or learns a wrong material.
    """
    rng, n = np.random.default_rng(1), 20_000
    mu, phi, turn = (
        rng.uniform(0.02, 1, (2, n)),
        rng.uniform(0, 2 * np.pi, (2, n)),
        rng.uniform(0, 2 * np.pi, n),
    )
    wi, wo = (direction(m, p) for m, p in zip(mu, phi, strict=True))
    values = numbers(source.eval(wi, wo))
    assert np.isfinite(values).all(), "a value is not finite"
    assert 0 <= 2 * np.pi * values.mean() <= 1.05, "the mean albedo is outside of 0 .. 1"
    for a, b in ((-wi, wo), (wi, -wo)):
        assert not numbers(source.eval(a, b)).any(), "a value below the horizon is not 0"
    if source.isotropic:
        turned = (direction(m, p + turn) for m, p in zip(mu, phi, strict=True))
        np.testing.assert_allclose(
            numbers(source.eval(*turned)), values, rtol=0.02, atol=0.002 * values.max()
        )


@pytest.mark.parametrize("ending", sources.FORMATS)
def test_a_file_of_each_format_gives_a_possible_material(ending, tmp_path, request):
    assert ending in EXAMPLES, (
        f"the tests have no {ending} file: add a line for '{ending}' to EXAMPLES in tests/test_source_registries.py"
    )
    example, path = EXAMPLES[ending], tmp_path / f"grey{ending}"
    if isinstance(example, str):
        path = request.getfixturevalue("measurements") / example
    else:
        example(path)
    names = sources.format_of(path).names
    check_values(sources.read(path, names(path)[0] if names else None))


@pytest.mark.parametrize(
    "source",
    [
        Formula(lambda wi, wo: Color.of(-7.0) + wo.z * 0.0),
        Formula(lambda wi, wo: Color.of(50.0) * wo.z),
        Formula(lambda wi, wo: Color.of(float("nan")) * wo.z),
        Formula(lambda wi, wo: Color.of(0.3) * wo.z * (1.0 + wo.x)),
    ],
    ids=["negative", "too bright", "not finite", "anisotropic"],
)
def test_an_impossible_source_is_found(source):
    check_values(LAMBERT)
    with pytest.raises(AssertionError):
        check_values(source)


def check_walks(source, materials=40, walks=2000):
    """Walks leave in unit directions, with finite throughputs of at least 0, whose mean is at most 1 per material."""
    rng, n = np.random.default_rng(2), materials * walks
    params = np.repeat(source.space.sample(rng, materials), walks, axis=0)
    wi = direction(rng.uniform(0.05, 1, n), rng.uniform(0, 2 * np.pi, n))
    wo, throughput = walk(source, source.gather(lanes(*params.T)), wi, dr.auto.PCG32(n, 3))
    found = numbers(throughput)
    assert np.isfinite(found).all() and (found >= 0).all(), "a throughput is negative or not finite"
    left = found.any(axis=1)
    assert left.any(), "no walk leaves the material"
    out = np.stack([c.numpy() for c in wo], axis=-1)[left]
    assert (out[:, 2] > 0).all(), "a walk leaves below the horizon"
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, atol=1e-3)
    each = found.reshape(materials, walks, 3)
    error = each.std(axis=1) / np.sqrt(walks)
    assert (each.mean(axis=1) <= 1 + 6 * error + 1e-4).all(), (
        "a material reflects more light than it receives"
    )


@pytest.mark.parametrize("name", sources.CLASSES)
def test_walks_of_each_class_are_possible(name):
    check_walks(sources.get(name))


@pytest.mark.parametrize("factor", [-1.0, 2.0, float("inf")])
def test_an_impossible_class_is_found(factor):
    class Faulty(Layered3):
        def step(self, params, walk, rng):
            after = super().step(params, walk, rng)
            after.throughput = tuple(factor * c for c in after.throughput)
            return after

    with pytest.raises(AssertionError):
        check_walks(Faulty())
