"""Reads and writes image files, measures errors of images, and draws contact sheets."""
