"""Benches: scripts that measure running times, and the error of a rendered frame relative to its rendering time."""
