"""Neural Material Adapter: expensive materials translated into blends of Principled BRDFs by a tiny network."""

__version__ = "0.1.0"
