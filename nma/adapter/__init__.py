"""Joins a network, an encoding and a target to an adapter, and reads and writes weights files.

The folder `trained` contains the shipped adapters.
"""

from nma.adapter.adapter import DEFAULT_ADAPTER, Adapter, shipped, weights_file

__all__ = ["DEFAULT_ADAPTER", "Adapter", "shipped", "weights_file"]
