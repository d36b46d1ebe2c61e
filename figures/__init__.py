"""Experiments: what the figures and tables of the project are made by."""
