"""Runs test programs in Mitsuba's scalar renderer, with our compiled plugins, in processes of their own."""

import json
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from nma.native import build

MATERIAL = {
    "alpha_top": 0.08,
    "alpha_bottom": 0.25,
    "eta_top": 1.5,
    "eta_conductor": {"type": "rgb", "value": [0.14, 0.37, 1.44]},
    "k_conductor": {"type": "rgb", "value": [3.98, 2.38, 1.6]},
    "albedo": {"type": "rgb", "value": [0.9, 0.3, 0.2]},
    "sigma_t": 0.5,
}
CHECKS = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.9, 0.2, 0.1]}, "color1": 0.3}
# Every test program begins with the following text, which reads the arguments and sets Mitsuba's variant.
PRELUDE = """
import json, sys
import mitsuba as mi
import numpy as np
import nma.render

variant, *words = json.loads(sys.argv[1])
nma.render.use(variant)


def refusal(call):
    try:
        call()
    except Exception as error:
        return str(error)
    raise AssertionError("nothing was refused")


def interaction(cosine, azimuth=0.0):
    si = mi.SurfaceInteraction3f()
    sine = np.sqrt(1 - cosine**2)
    si.wi = [float(sine * np.cos(azimuth)), float(sine * np.sin(azimuth)), cosine]
    return si
"""


def plugins() -> Path:
    """Compiles the plugins and returns their folder, which lies in the cache that `conftest.py` chooses."""
    if shutil.which("c++") is None:
        pytest.skip("there is no C++ compiler here")
    return build.build_mitsuba()


def run(program: str, variant: str, *words) -> subprocess.CompletedProcess:
    """Runs `PRELUDE` and then `program`, which finds the arguments in its variable `words`."""
    text = PRELUDE + textwrap.dedent(program)
    command = [sys.executable, "-c", text, json.dumps([variant, *words])]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def finished(program: str, variant: str, *words) -> list[str]:
    """Runs a program and returns the lines that it prints. The test fails if the program fails."""
    done = run(program, variant, *words)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.splitlines()
