"""Adapters: a network with its encoding and its weights file; those that come with the package lie in `trained`."""

from nma.adapter.adapter import Adapter, shipped, weights_file

__all__ = ["Adapter", "shipped", "weights_file"]
