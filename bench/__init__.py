"""Benches: they measure how long things take, and how good a frame is for its time."""
