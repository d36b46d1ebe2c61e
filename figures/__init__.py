"""Experiments: scripts that make the plots, pictures and tables of results in this folder."""
