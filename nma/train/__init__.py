"""Training of adapters with JAX, an optional extra: `pip install neural-material-adapter[train]`."""

from nma.errors import MissingDependencyError

try:
    import jax  # noqa: F401
    import optax  # noqa: F401
except ImportError as e:
    raise MissingDependencyError(
        f"training needs JAX and optax ({e.name} is missing); "
        "install them with: pip install 'neural-material-adapter[train]'"
    ) from None
