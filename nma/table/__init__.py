"""BSDF tables: their grid and files, and what makes them, from walks or from known values."""

from nma.table.grid import ANISOTROPIC, ISOTROPIC, Grid, Tables, kept
from nma.table.walks import stream_keys, tabulate

__all__ = ["ANISOTROPIC", "ISOTROPIC", "Grid", "Tables", "kept", "stream_keys", "tabulate"]
