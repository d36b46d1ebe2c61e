"""Untrained adapters and random materials, which several test files share."""

import numpy as np

from nma import network, target
from nma.adapter import Adapter, encoding
from nma.params import LAYERED3, MEASURED
from nma.target import ANISOTROPIC_PARAMS, INTERFACE_PARAMS, PRINCIPLED_PARAMS

VARIANTS = {"single": (1, False), "blended": (2, False), "omega_i": (1, True), "blended + omega_i": (2, True)}


def random_adapter(
    instances=2,
    directional=True,
    name="layered3",
    hidden="3x32",
    seed=0,
    params=PRINCIPLED_PARAMS,
    space=LAYERED3,
    skip=False,
    **fields,
):
    """Returns an untrained adapter. With `skip`, the last layer reads the inputs of the network, too.

    The random weights are large enough that the outputs of the network vary over the class.
    """
    rng = np.random.default_rng(seed)
    sizes = [
        encoding.size(name, space, directional),
        *network.hidden(hidden),
        target.output_size(instances, params),
    ]
    layers = [(m, 0.3 * rng.standard_normal(b.shape).astype(np.float32)) for m, b in network.init(rng, sizes)]
    matrix = 10.0 * layers[-1][0]
    if skip:
        more = 0.3 * rng.standard_normal((len(matrix), sizes[0]))
        matrix = np.concatenate([matrix, more], axis=1, dtype=np.float32)
    layers[-1] = (matrix, layers[-1][1])
    record = {"data": "none", "seed": seed}
    return Adapter(space, name, layers, instances, directional, params, record, **fields)


def random_interface_adapter(hidden="3x32", seed=0, bounded=True, instances=2):
    """Returns an untrained adapter whose target lies under the coat, and whose last layer reads the inputs, too."""
    about = {"name": "layered3_bounce", "params": INTERFACE_PARAMS, "interface": LAYERED3.interface}
    return random_adapter(instances, hidden=hidden, seed=seed, bounded=bounded, skip=True, **about)


def random_anisotropic_adapter(hidden="3x32", seed=0):
    """Returns an untrained adapter of a single material that is anisotropic."""
    about = {"name": "azimuth", "params": ANISOTROPIC_PARAMS, "space": MEASURED}
    return random_adapter(hidden=hidden, seed=seed, **about)


def materials(n, seed=1):
    return LAYERED3.sample(np.random.default_rng(seed), n)
