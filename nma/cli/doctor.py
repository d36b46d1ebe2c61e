"""The command `nma doctor`: lists the components that are missing on this machine, and how to install them."""

from __future__ import annotations

import typer

from nma.cli import console


def register(app: typer.Typer) -> None:
    app.command()(doctor)


def doctor() -> None:
    """Check that everything the package needs is installed, and print how to install what is missing."""
    from nma.doctor import check

    findings = check()
    rows = [(f.name, "ok" if f.ok else "optional" if f.optional else "MISSING", f.found) for f in findings]
    console.out.print(console.table(("what", "state", "found"), rows))
    # Each command that installs a component is printed on a single, unbroken line, so that the user can copy it.
    for f in findings:
        if not f.ok:
            console.tell(f"\n{f.name}:\n  {f.fix}")
    if not all(f.ok or f.optional for f in findings):
        raise typer.Exit(1)
