"""Scripts for developers: they write generated files of the repository, and set up a checkout."""
