"""Runs the program `nma` for `python -m nma.cli`."""

from nma.cli import main

main()
