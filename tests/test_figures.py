"""Every experiment in `figures/` runs in its quick form and writes its results.

The tests search the folder for experiments, so that new experiments are tested too.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import nma
from figures.energy import run as energy
from nma import ops
from nma.lattice import lattice_points

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


@pytest.mark.slow
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


def test_albedos_of_the_experiment_energy_are_integrals_of_the_value():
    """The mean of value / pdf over samples equals the integral of the value over uniform directions, within .5 %."""
    adapter, cosines = nma.Adapter.load("layered3-3x32"), np.array([0.3, 0.9])
    material = {"alpha_top": 0.3, "alpha_bottom": 0.6, "eta_top": 1.4, "eta_conductor": 1.0}
    params = nma.LAYERED3.vector(material | {"k_conductor": 4.0, "albedo": 0.7, "sigma_t": 0.5})[None]
    found = energy.albedos(adapter, params, cosines, np.arange(2), 4096, 0.0)
    z, turn = lattice_points(1 << 14, 2).T
    sine, phi = np.sqrt(1.0 - z * z), 2.0 * np.pi * turn
    for cosine, albedo in zip(cosines, found, strict=True):
        wi = ops.at_azimuth_0(np.full(len(z), cosine))
        brdf = adapter.prepare([np.full(len(z), x) for x in params[0]], wi)
        value = brdf.eval(wi, ops.Vec3(sine * np.cos(phi), sine * np.sin(phi), z))
        assert albedo == pytest.approx(2.0 * np.pi * max(c.mean() for c in value), rel=5e-3)


def test_the_experiment_energy_reports_the_brightest_pair(monkeypatch):
    params, brightest = np.arange(39.0).reshape(3, 13), 2 * energy.ANGLES + 5

    def albedos(adapter, params, mu, pairs, samples, shift):
        return np.where(pairs == brightest, 1.2, 0.9) + 0.01 * (shift - 0.25)

    monkeypatch.setattr(energy, "albedos", albedos)
    found, envelope = energy.measure(None, params, ((None, 1), (4, 2)))
    assert found == {
        "largest_albedo": 1.2,
        "error": 0.0025,
        "pairs_above_1": 1,
        "cos_theta_i": 5.5 / energy.ANGLES,
        "material": params[2].tolist(),
    }
    assert envelope.argmax() == 5 and len(envelope) == energy.ANGLES


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
