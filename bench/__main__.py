"""Lists the benches, or runs them one after the other.

python -m bench                                         list all benches
python -m bench all [--quick] [--output FOLDER]         run all of them
python -m bench NAME ... [--quick] [--output FOLDER]    run some of them
python -m bench.NAME --help                             show the options of one bench
"""

from __future__ import annotations

import argparse
import ast
import subprocess
import sys
from pathlib import Path

from nma.files import into_pipe

HERE = Path(__file__).parent
# Benches that write no files, each with its options for a quick run.
PRINTING = {"training": ["--steps", "60"], "walks": ["--walks", "81920", "--repeat", "1"]}


def benches() -> dict[str, Path]:
    """Returns the name and the script of every bench. A bench is a file in this folder that runs as a script."""
    scripts = sorted(HERE.glob("*.py"))
    return {s.stem: s for s in scripts if s != Path(__file__) and '__name__ == "__main__"' in s.read_text()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument(
        "--quick", action="store_true", help="small, short runs, to see that the benches work"
    )
    parser.add_argument("--output", type=Path, help="folder for the results")
    arguments = parser.parse_args()
    known = benches()
    if not arguments.names:
        for name, script in known.items():
            print(f"{name:12} {(ast.get_docstring(ast.parse(script.read_text())) or '').splitlines()[0]}")
        return
    unknown = set(arguments.names) - {"all", *known}
    if unknown:
        sys.exit(f"no bench {', '.join(sorted(unknown))}; the benches are {', '.join(known)}")
    if arguments.output:
        arguments.output.mkdir(parents=True, exist_ok=True)
    for name in known if "all" in arguments.names else arguments.names:
        options = words(name, arguments.quick, arguments.output)
        command = [sys.executable, "-m", f"bench.{name}", *options]
        print(f"== {name}: {' '.join(command[1:])}", flush=True)
        subprocess.run(command, check=True)


def words(name: str, quick: bool, output: Path | None) -> list[str]:
    """Returns the command-line options for one bench."""
    if name in PRINTING:
        return PRINTING[name] if quick else []
    if name == "runtime":
        return ["--json", str(output / "runtime.json")] if output else []
    return (["--quick"] if quick else []) + (["--output", str(output)] if output else [])


if __name__ == "__main__":
    with into_pipe():
        main()
