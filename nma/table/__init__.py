"""BSDF tables: their grid, their files, and how they are made from random walks or from sources with known values."""

from nma.table.grid import ANISOTROPIC, ISOTROPIC, Grid, Tables, kept
from nma.table.walks import stream_keys, tabulate

__all__ = ["ANISOTROPIC", "ISOTROPIC", "Grid", "Tables", "kept", "stream_keys", "tabulate"]
