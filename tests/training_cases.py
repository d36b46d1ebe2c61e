"""A small recipe, tables and networks for the tests of training."""

import math
from dataclasses import replace

import numpy as np

from nma import target
from nma.adapter import Adapter
from nma.ops import Color
from nma.params import LAYERED3
from nma.table import ISOTROPIC, Tables
from nma.target import PRINCIPLED_PARAMS, STRETCHED_PARAMS, Blend, Principled
from nma.train.batches import BinSampler, Pool, draw
from nma.train.loss import bin_means, brdf_of
from nma.train.recipe import CLASS

FALSE_ALARM = 1e-3
TINY = replace(CLASS, network="2x8", rows=16, bins_per_row=4, points=4, steps=250, learning_rate=1e-2)

# The blend that training must recover: brass under a varnish, as two instances.
BRASS = Blend(
    (
        Principled(Color(0.9, 0.7, 0.4), 0.45, 1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.5),
        Principled(Color(0.6, 0.3, 0.1), 0.7, 0.0, 0.8, 0.0, 0.3, 0.5, 0.2, 0.2),
    ),
    (0.5, 0.5),
)


def lambertian(n, walks=819_200):
    """Returns noise-free tables of n Lambertian materials of random colours. Each bin holds rho / pi cos(theta_o)."""
    params = LAYERED3.sample(np.random.default_rng(0), n)
    rho = params[:, LAYERED3.slices["albedo"]]
    cosines = (np.arange(40) + 0.5) / 40
    values = rho[:, None, None, None, :] / math.pi * cosines[None, None, :, None, None]
    values = np.broadcast_to(values, (n, *ISOTROPIC.shape)).astype(np.float16)
    return Tables(params, values, np.full(n, walks))


def batch_of(tables, recipe, step=0):
    return draw(Pool.of(tables), BinSampler(recipe.bins_law), recipe, step)


def means_of(layers, batch, recipe):
    return np.asarray(bin_means(brdf_of(layers, batch, recipe), batch, recipe))


def constant_layers(blend, inputs=1, params=PRINCIPLED_PARAMS):
    """Returns a network of one layer. For every input, the raw output decodes to `blend`."""
    raw = np.array(target.encode(blend, params), np.float32)
    return [(np.zeros((len(raw), inputs), np.float32), raw)]


def constant_adapter(blend, params=PRINCIPLED_PARAMS):
    """Returns an adapter whose network has the same raw output for every input, the encoding of `blend`.

    With `STRETCHED_PARAMS`, the decoder still reduces the stretching towards normal incidence.
    """
    layers, in_plane = constant_layers(blend, params=params), params is STRETCHED_PARAMS
    return Adapter(LAYERED3, "direction", layers, len(blend.instances), in_plane, params)
