"""Trains adapters: fits their networks to tables or to BRDF values, with JAX.

JAX is an optional extra: in a checkout, `pip install '.[train]'`.
"""

from nma.errors import MissingDependencyError

try:
    import jax  # noqa: F401
    import optax  # noqa: F401
except ImportError as e:
    raise MissingDependencyError(
        f"training needs JAX and optax ({e.name} is missing); "
        "in a checkout of this project run: pip install '.[train]'"
    ) from None
