"""Benches: how long things take, and what a frame is worth."""
