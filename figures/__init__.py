"""Experiments: the scripts that make the figures and tables of the project."""
