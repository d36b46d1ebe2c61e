"""Untrained adapters and random materials, which several test files share."""

import numpy as np

from nma import network, target
from nma.adapter import Adapter, encoding
from nma.params import LAYERED3, MEASURED
from nma.target import ANISOTROPIC_PARAMS, PRINCIPLED_PARAMS

VARIANTS = {"single": (1, False), "blended": (2, False), "omega_i": (1, True), "blended + omega_i": (2, True)}


def random_adapter(
    instances=2,
    directional=True,
    name="layered3",
    hidden="3x32",
    seed=0,
    params=PRINCIPLED_PARAMS,
    space=LAYERED3,
):
    """Returns an untrained adapter.

    The random weights are large enough that the outputs of the network vary over the class.
    """
    rng = np.random.default_rng(seed)
    sizes = [
        encoding.size(name, space, directional),
        *network.hidden(hidden),
        target.output_size(instances, params),
    ]
    layers = [(m, 0.3 * rng.standard_normal(b.shape).astype(np.float32)) for m, b in network.init(rng, sizes)]
    layers[-1] = (10.0 * layers[-1][0], layers[-1][1])
    record = {"data": "none", "seed": seed}
    return Adapter(space, name, layers, instances, directional, params, record)


def random_anisotropic_adapter(hidden="3x32", seed=0):
    """Returns an untrained adapter of a single material that is anisotropic."""
    about = {"name": "azimuth", "params": ANISOTROPIC_PARAMS, "space": MEASURED}
    return random_adapter(hidden=hidden, seed=seed, **about)


def materials(n, seed=1):
    return LAYERED3.sample(np.random.default_rng(seed), n)
