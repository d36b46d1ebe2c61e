"""`nma doctor`: what is missing on this machine."""

from __future__ import annotations

import typer

from nma.cli import console


def register(app: typer.Typer) -> None:
    app.command()(doctor)


def doctor() -> None:
    """Check that everything the package needs is there. For what is missing, print the command that mends it."""
    from nma.doctor import check

    findings = check()
    rows = [(f.name, "ok" if f.ok else "optional" if f.optional else "MISSING", f.found) for f in findings]
    console.out.print(console.table(("what", "state", "found"), rows))
    # Each command has a line of its own, unbroken, so that it can be copied.
    for f in findings:
        if not f.ok:
            console.tell(f"\n{f.name}:\n  {f.fix}")
    if not all(f.ok or f.optional for f in findings):
        raise typer.Exit(1)
