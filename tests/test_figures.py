"""Every experiment in `figures/` runs in its quick form and writes its results.

The tests search the folder for experiments, so that new experiments are tested too.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXPERIMENTS = sorted(script.parent.name for script in (ROOT / "figures").glob("*/run.py"))

NEED_DATA = {"library"}
# Optimisations are off, because optimised compilation takes longer than the few training steps of a quick form.
ENVIRONMENT = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}


def figures(*words):
    command = [sys.executable, "-m", "figures", *words]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, env=ENVIRONMENT, timeout=600, check=False
    )


@pytest.mark.runs
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_runs_in_its_quick_form(name, request):
    if name in NEED_DATA:
        request.getfixturevalue("measurements")
    folder = ROOT / "out/figures" / name
    for old in [*folder.glob("*.json"), *folder.glob("*.png")]:
        old.unlink()
    run = figures(name, "--quick")
    assert run.returncode == 0, run.stdout + run.stderr
    found = list(folder.glob("*.json"))
    assert found
    assert all(json.loads(path.read_text()) for path in found)
    assert list(folder.glob("*.png"))


def test_committed_results_stand_beside_each_script():
    for name in EXPERIMENTS:
        home = ROOT / "figures" / name
        where = f"figures/{name}: "
        assert (home / "README.md").exists(), where + "add a README.md that says what the experiment shows"
        advice = f"run `python -m figures {name}` in full, and commit what it writes"
        assert list(home.glob("*.json")), where + "there are no results (.json); " + advice
        # A source distribution has no pictures of experiments (pyproject.toml).
        if (ROOT / ".git").exists():
            assert list(home.glob("*.png")), where + "there is no picture (.png); " + advice


def test_the_command_without_a_name_lists_all_experiments():
    lines = figures().stdout.splitlines()
    assert [line.split()[0] for line in lines] == EXPERIMENTS
    assert all(len(line.split()) > 3 for line in lines)
    unknown = figures("no-such-figure")
    assert unknown.returncode != 0
    assert "no experiment no-such-figure" in unknown.stderr
