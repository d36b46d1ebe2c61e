"""Adapters: a network with its encoding and its weights file. The folder `trained` contains the shipped adapters."""

from nma.adapter.adapter import Adapter, shipped, weights_file

__all__ = ["Adapter", "shipped", "weights_file"]
