"""Scripts that write committed files, and a script that sets up a checkout."""
