"""`python -m nma.cli` is the `nma` command."""

from nma.cli import main

main()
