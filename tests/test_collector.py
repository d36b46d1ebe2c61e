"""The garbage collector destroys no BSDF while Dr.Jit records, and destroys unreachable BSDFs afterwards."""

import gc
import json
import os
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

import nma.render
from nma.jit import dr
from nma.render import bsdf as common

nma.render.use("llvm_ad_rgb")

LAYERED = {"type": "layered", "material": "frosted-silver"}
BLEND = {"type": "blendbsdf", "weight": 0.5, "a": LAYERED, "b": LAYERED}


@pytest.fixture
def no_collector():
    nma.render.use("llvm_ad_rgb")
    gc.collect()
    gc.disable()
    kept = mi.load_dict({"type": "diffuse"})  # `_registered` needs at least one BSDF
    yield kept
    gc.enable()


# Renders a scene while a second scene is in a reference cycle. The BSDF of the second scene starts the garbage
# collector.
RENDER = """
import gc, json, sys
import mitsuba as mi, numpy as np
import nma.render
nma.render.use("llvm_ad_rgb")
gc.disable()
def load(bsdf):
    sensor = {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}
    ball = {"type": "sphere", "center": [0, 0, 3], "bsdf": bsdf}
    return mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant"},
                         "sensor": sensor, "ball": ball})
def eval_pdf(self, *args):
    collections.append(self is ours or gc.collect())
    return plain(self, *args)
kept = load({"type": "layered", "material": "frosted-silver"})
ours = next(part for part in mi.traverse(kept).hierarchy if type(part).__name__ == "Layered")
cycle = [load(json.loads(sys.argv[1]))]
cycle.append(cycle)
del cycle
collections, plain = [], type(ours).eval_pdf
type(ours).eval_pdf = eval_pdf
assert np.isfinite(np.array(mi.render(kept, spp=1))).all()
assert len(collections) > collections.count(True), "the second scene was not called"
"""


@pytest.mark.parametrize(
    "bsdf", [LAYERED, {"type": "twosided", "inner": LAYERED}, BLEND], ids=lambda b: b["type"]
)
def test_a_collection_while_a_scene_is_recorded_does_not_crash(bsdf):
    # With MALLOC_PERTURB_, glibc overwrites memory that is freed, so using freed memory crashes at once.
    environment = os.environ | {"MALLOC_PERTURB_": "165"}
    command = [sys.executable, "-c", RENDER, json.dumps(bsdf)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_search_for_blends_keeps_no_bsdf_in_memory(no_collector):
    before = len(common._registered())
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": BLEND}})
    ours = next(part for part in mi.traverse(scene).hierarchy if type(part).__name__ == "Layered")
    assert common.blended(ours)
    assert len(common._registered()) > before
    del scene, ours
    assert len(common._registered()) == before


def test_postponed_garbage_is_freed_when_the_next_bsdf_is_loaded(no_collector):
    cycle = [mi.load_dict(LAYERED)]
    serial = cycle[0].serial
    cycle.append(cycle)
    del cycle
    alive = lambda: serial in [common._serial(bsdf) for bsdf in common._registered()]  # noqa: E731

    def body(i):
        gc.collect()
        return (i + 1,)

    (last,) = dr.while_loop((mi.UInt32(0),), lambda i: i < 3, body)
    assert np.array(last)[0] == 3
    assert alive()
    kept = mi.load_dict(LAYERED)
    assert kept.serial != serial and not alive()
