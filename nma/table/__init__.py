"""Computes the mean of a source over each bin of a table, from random walks or BRDF values.

The package also defines the grid of the bins, and reads and writes the files of tables.
"""

from nma.table.grid import ANISOTROPIC, ISOTROPIC, Grid, Tables, kept
from nma.table.walks import stream_keys, tabulate

__all__ = ["ANISOTROPIC", "ISOTROPIC", "Grid", "Tables", "kept", "stream_keys", "tabulate"]
