"""Random parameters and directions for the tests of the target."""

import numpy as np

from nma.ops import Color, Vec3
from nma.target import Blend, Interface, Principled

# Arguments of `jax.jit` for tests that spend most of their time on compiling. The options turn off slow passes of XLA's
# compiler, above all the fusion of the target's operations into large kernels.
FAST_COMPILE = {
    "compiler_options": {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
}


def random_principled(
    rng: np.random.Generator, n: int, dialect: bool = True, fades: bool = False
) -> Principled:
    """Returns n random parameter sets.

    The roughness is log-uniform from .03 to 1, and many parameters are exactly 0 or 1.

    With `dialect`, `anisotropic` and `flatness` are random too, which the targets of the paper do not have. With
    `fades`, `fade` and `fade_width` are random too, which Mitsuba's BSDF `principled` does not have.
    """

    def often_pure():
        u = rng.random(n)
        return np.where(rng.random(n) < 0.4, np.round(u), u)

    return Principled(
        base_color=Color(*rng.random((3, n)) ** 2),
        roughness=10.0 ** rng.uniform(-1.5, 0.0, n),
        metallic=often_pure(),
        specular=rng.uniform(0.001, 1.8, n),
        spec_tint=often_pure(),
        sheen=often_pure(),
        sheen_tint=often_pure(),
        clearcoat=often_pure(),
        clearcoat_gloss=often_pure(),
        anisotropic=often_pure() * dialect,
        flatness=often_pure() * dialect,
        **_fades(rng, n) if fades else {},
    )


def _fades(rng: np.random.Generator, n: int) -> dict:
    return {"fade": rng.uniform(-0.3, 1.0, n), "fade_width": 10.0 ** rng.uniform(-1.3, 0.0, n)}


def random_blend(
    rng: np.random.Generator, n: int, n_instances: int, dialect: bool = True, fades: bool = False
) -> Blend:
    """Returns n blends of `n_instances` random instances. The weights of each blend are random and sum to one."""
    weights = rng.dirichlet(np.ones(n_instances), n).T
    return Blend(tuple(random_principled(rng, n, dialect, fades) for _ in range(n_instances)), tuple(weights))


def below_interface(rng: np.random.Generator, blend: Blend) -> Blend:
    """Returns the blends under random interfaces. The index of every tenth interface is 1, so that it does not
    reflect. Narrow lobes are not shifted: in single precision, the rounding of a shifted direction changes the flank of
    a lobe of width .001 by .3 per cent."""
    n = len(blend.weights[0])
    eta = np.where(rng.random(n) < 0.1, 1.0, rng.uniform(1.0, 2.5, n))
    instances = tuple(
        p._replace(veil=rng.random(n), shift=rng.uniform(-0.6, 1.0, n) * (p.roughness > 0.15))
        for p in blend.instances
    )
    return blend._replace(instances=instances, interface=Interface(10.0 ** rng.uniform(-3.0, 0.0, n), eta))


def random_directions(rng: np.random.Generator, n: int) -> Vec3:
    """Returns n random directions above the horizon, uniform in the cosine. Every tenth direction is near grazing."""
    z = rng.random(n)
    z = np.where(rng.random(n) < 0.1, 10.0 ** rng.uniform(-6, -1, n), z)
    phi = rng.uniform(0, 2 * np.pi, n)
    sin_theta = np.sqrt(1 - z * z)
    return Vec3(sin_theta * np.cos(phi), sin_theta * np.sin(phi), z)


def horizon_pairs():
    """Returns pairs of directions, wi (n, 3) and wo (n, 3), of which at least one is at or below the horizon.

    In some pairs, the two directions are equal or opposite.
    """
    z = np.array([1.0, 0.5, 1e-9, 1e-20, 0.0, -0.0, -1e-20, -1e-9, -0.5, -1.0])
    one = np.stack([np.sqrt(1.0 - z * z), 0.0 * z, z], axis=-1)
    wi = np.tile(np.repeat(one, len(z), axis=0), (2, 1))
    wo = np.concatenate([np.tile(one * side, (len(z), 1)) for side in ([1, 1, 1], [-1, 1, 1])])
    hidden = (wi[:, 2] <= 0) | (wo[:, 2] <= 0)
    return wi[hidden], wo[hidden]


def mapped(tree, f):
    """Applies `f` to every array in nested tuples, and returns the new tuples. Python numbers remain unchanged."""
    if isinstance(tree, tuple):
        parts = [mapped(t, f) for t in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return f(tree) if isinstance(tree, np.ndarray) else tree


def stacked(c: Vec3) -> np.ndarray:
    """Converts a triple of arrays of any array package to a NumPy array (3, ...)."""
    return np.stack(np.broadcast_arrays(*(np.asarray(x) for x in c)))
