"""Lists the experiments, or runs them.

python -m figures                     list all experiments
python -m figures all [--quick]       run all of them
python -m figures NAME ... [--quick]  run some of them
python -m figures.NAME.run --help     show the options of one experiment
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

from nma.files import into_pipe

HERE = Path(__file__).parent


def experiments() -> dict[str, Path]:
    """Returns the name and the script of every experiment: a folder of figures/ that contains a file `run.py`."""
    return {script.parent.name: script for script in sorted(HERE.glob("*/run.py"))}


def main() -> None:
    known, wanted = experiments(), [word for word in sys.argv[1:] if word != "--quick"]
    quick = ["--quick"] if "--quick" in sys.argv else []
    if not wanted:
        for name, script in known.items():
            summary = (ast.get_docstring(ast.parse(script.read_text())) or "").splitlines()[0]
            print(f"{name:12} {summary}")
        return
    unknown = set(wanted) - {"all", *known}
    if unknown:
        sys.exit(f"no experiment {', '.join(sorted(unknown))}; the experiments are {', '.join(known)}")
    for name in known if "all" in wanted else wanted:
        command = [sys.executable, "-m", f"figures.{name}.run", *quick]
        print(f"== {name}: {' '.join(command[1:])}", flush=True)
        subprocess.run(command, check=True)


if __name__ == "__main__":
    with into_pipe():
        main()
