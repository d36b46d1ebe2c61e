"""Training adapters whose target lies under the interface of their class."""

from dataclasses import replace

import numpy as np
import pytest
from target_cases import FAST_COMPILE

pytest.importorskip("jax", reason="training needs JAX, the extra [train]", exc_type=ImportError)
pytest.importorskip("optax", reason="training needs optax, the extra [train]", exc_type=ImportError)

import jax

import nma
from nma import network, ops
from nma.adapter import Adapter, encoding
from nma.errors import NmaError
from nma.microfacet import fresnel_conductor_rgb, fresnel_dielectric
from nma.ops import Color, Vec3
from nma.params import LAYERED3, MEASURED
from nma.table.dataset import Settings, simulate_block
from nma.train import loop
from nma.train.batches import BinSampler, Pool, draw
from nma.train.loss import distance
from nma.train.recipe import for_class
from nma.train.run import initial_layers, train_class

RECIPE = for_class(LAYERED3, network="2x16", rows=64, steps=300)


@pytest.fixture(scope="module")
def tables():
    return simulate_block(Settings("layered3", 8, 40_960, 0), range(8))


def test_the_class_chooses_the_target_and_the_encoding_with_estimates():
    assert (RECIPE.target, RECIPE.encoding) == ("interface", "layered3_bounce")
    assert for_class(LAYERED3, "single").target == "interface"
    for changes in ({"target": "stretched"}, {"directional": False}, {"name": "paper"}):
        plain = for_class(LAYERED3, **changes)
        assert (plain.encoding, plain.dim) == ("raw" if changes.get("name") else "layered3", 0.0)
        assert plain.target == changes.get("target", "principled")
    assert for_class(MEASURED, "single").target == "stretched"


def test_classes_without_an_interface_are_refused():
    recipe = for_class(MEASURED, "single", target="interface")
    with pytest.raises(NmaError, match="class measured has no interface"):
        initial_layers(recipe, MEASURED)


def test_training_starts_at_the_estimates_of_a_single_bounce():
    """Before the first step, the first instance has the colour of light that is refracted, reflected by the conductor
    and refracted out, within the clipping of the estimates."""
    layers = initial_layers(RECIPE, LAYERED3)
    matrix, bias = layers[-1]
    matrix[:, : -network.skip_width(layers)] = 0.0
    adapter = Adapter(
        LAYERED3,
        RECIPE.encoding,
        [*layers[:-1], (matrix, bias)],
        2,
        True,
        nma.target.INTERFACE_PARAMS,
        interface=LAYERED3.interface,
    )
    columns = list(LAYERED3.sample(np.random.default_rng(0), 200).T)
    mu = np.random.default_rng(1).uniform(0.05, 1.0, 200)
    found = adapter.prepare(columns, ops.at_azimuth_0(mu)).blend
    alpha_top, alpha_bottom, eta_top, *rest = columns
    fresnel, cos_t = fresnel_dielectric(mu, eta_top)
    metal = fresnel_conductor_rgb(
        cos_t, Color(*(x / eta_top for x in rest[0:3])), Color(*(x / eta_top for x in rest[3:6]))
    )
    crossed = (1.0 - fresnel) * np.exp(-rest[9] * (1.0 + 1.0 / cos_t))
    for channel, wanted in zip(found.instances[0].base_color, metal, strict=True):
        np.testing.assert_allclose(channel, np.clip(wanted * crossed, 0.01, 0.99), atol=1e-4)
    assert found.interface.alpha is columns[0] and found.interface.eta is columns[2]
    # A smooth coat leaves the width of the conductor's lobe unchanged.
    smooth = alpha_top < 0.01 * alpha_bottom
    np.testing.assert_allclose(
        found.instances[0].roughness[smooth] ** 2, np.maximum(alpha_bottom, 1.1e-3)[smooth], rtol=0.08
    )


@pytest.mark.slow
def test_training_lowers_the_loss_and_the_file_keeps_the_interface(tables, tmp_path):
    adapter, run = train_class(LAYERED3, RECIPE, tables, {})
    assert np.mean(run.losses[-50:]) < 0.7 * np.mean(run.losses[:10])
    adapter.save(tmp_path / "w.safetensors")
    again = Adapter.load(tmp_path / "w.safetensors")
    assert again.interface == ("alpha_top", "eta_top")
    assert (again.outputs, again.size) == (19, 21)
    assert network.skip_width(again.layers) == encoding.size("layered3_bounce", LAYERED3, True)
    wi = Vec3(0.6, 0.0, 0.8)
    columns = list(tables.params[0])
    for a, b in zip(
        adapter.prepare(columns, wi).eval(wi, wi), again.prepare(columns, wi).eval(wi, wi), strict=True
    ):
        np.testing.assert_allclose(a, b)


def test_latent_codes_are_trained_without_the_interface_of_the_class(tables):
    """The only column of a batch is the index of the material, and no column is taken for the interface."""
    batch = draw(Pool.numbered(tables), BinSampler("uniform"), RECIPE, 0)
    assert batch.interface.shape == (0, 64)
    assert set(batch.columns[0]) <= set(range(8)) and len(batch.columns) == 1
    assert draw(Pool.of(tables), BinSampler("uniform"), RECIPE, 0).interface.shape == (2, 64)


def test_the_term_for_dim_bins_sees_relative_errors(tables):
    """A factor of 2 in dim bins hardly changes the loss of eq. 7, but the loss with the term for dim bins."""
    recipe = for_class(LAYERED3, rows=64)
    batch = draw(Pool.of(tables), BinSampler("uniform"), recipe, 0)
    dim = batch._replace(value=np.full_like(batch.value, 0.01), quantum=1e-6 + 0.0 * batch.quantum)

    def found(weight):
        changed = for_class(LAYERED3, rows=64, dim=weight)
        measure = jax.jit(lambda mean: distance(mean, dim, changed)[0], **FAST_COMPILE)
        return float(measure(0.02 + 0.0 * dim.value) - measure(dim.value))

    plain, weighed = found(0.0), found(1.0)
    # log(.02 + .02) - log(.02 + .01), of which the Huber loss takes nearly all
    np.testing.assert_allclose(weighed - plain, np.log(4 / 3), rtol=0.05)
    assert plain < 0.012


def test_a_target_may_be_without_some_parameters(tables, tmp_path):
    """The network has no outputs for them, and they are 0. A checkpoint of such a run can be continued."""
    recipe = replace(RECIPE, network="1x8", without=("shift", "anisotropic"), steps=2)
    checkpoint = tmp_path / "c"
    adapter, _ = train_class(LAYERED3, recipe, tables, {}, checkpoint=checkpoint)
    assert adapter.outputs == 15
    blend = adapter.prepare(list(tables.params[0]), Vec3(0.6, 0.0, 0.8)).blend
    assert all((p.shift, p.anisotropic) == (0.0, 0.0) and p.veil > 0.0 for p in blend.instances)
    assert loop.resume(recipe, adapter.layers, checkpoint).step == 2
    with pytest.raises(NmaError, match="cannot be without sheen; it can be without anisotropic, flatness"):
        replace(RECIPE, without=("sheen",))
