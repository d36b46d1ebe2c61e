"""Tests of the benches that render whole frames: their statistics are right, and each bench runs."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import nma.render
from bench import density, frames, runtime, samples, scenes, settings
from nma.render.scene import CAMERAS

ROOT = Path(__file__).parent.parent
# The names of the benches that write a picture of their results in addition to a JSON file.
PICTURED = ["density", "networks", "render", "samples", "scalar", "settings", "teaser"]
UNPICTURED = ["reciprocity", "runtime", "training", "walks"]
SIMULATION = {"seconds": 2.0, "variance": 0.4, "error": 0.4, "doubt": 0.03}
ADAPTER = {"seconds": 1.0, "variance": 0.2, "error": 0.5, "doubt": 0.04}
OTHER = {"seconds": 1.0, "variance": 0.2, "error": None, "doubt": None}


def bench(*words):
    command = [sys.executable, "-m", "bench", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=900, check=False)


def test_adapters_are_called_by_their_names_without_the_class():
    names = [
        "layered3-3x32",
        "layered3-principled-5x64",
        "some/layered3-a.b.safetensors",
        "other.safetensors",
    ]
    assert [runtime.label(name) for name in names] == ["3x32", "principled-5x64", "a.b", "other"]


def test_efficiency_is_the_inverse_of_noise_times_time():
    found = frames.ratios(ADAPTER, SIMULATION)
    expected = {"time": 0.5, "variance": 0.5, "error": 1.25, "efficiency by variance": 4.0}
    assert found == pytest.approx(expected | {"efficiency by error": 1.6})
    assert set(frames.ratios(SIMULATION, SIMULATION).values()) == {1.0}
    unknown = frames.ratios(OTHER, SIMULATION)
    assert unknown["efficiency by variance"] == 4.0
    assert unknown["error"] is None
    assert unknown["efficiency by error"] is None


def test_the_gain_over_the_simulation_has_a_standard_error():
    """Half the time and half the noise make the efficiency eight times as large. The error covers the truth."""
    noise = np.random.default_rng(1).normal(size=(2, 12, 8, 8, 3))
    simulation = frames.Frames(noise[0], np.full(12, 2.0), np.full(12, 2.0))
    adapter = frames.Frames(0.5 * noise[1], np.full(12, 1.0), np.full(12, 1.0))
    found, error = frames.gain(adapter, simulation)
    # The variances have 11 x 192 degrees of freedom each, so the standard error is 8 sqrt(4 / 2112), or .35.
    assert error == pytest.approx(0.35, rel=0.5)
    assert abs(found - 8.0) < 3.0 * error
    assert frames.gain(simulation, simulation) == (1.0, 0.0)
    assert (
        frames.gain(*(f._replace(pictures=f.pictures[:2], wall=f.wall[:2]) for f in (adapter, simulation)))[1]
        is None
    )


def test_there_is_no_ratio_of_errors_that_are_not_positive():
    assert frames.ratio(-0.1, 0.4) is None
    assert frames.ratio(0.1, 0.0) is None


def test_means_are_geometric_and_skip_unknown_ratios():
    assert frames.geometric_mean([0.5, None, 2.0]) == pytest.approx(1.0)
    assert frames.geometric_mean([None]) is None
    twice = {**ADAPTER, "seconds": 4.0}
    rows = [{"layered": SIMULATION, "nma": ADAPTER}, {"layered": SIMULATION, "nma": twice}]
    means = frames.mean_ratios(rows, "layered")
    assert means["nma"]["time"] == pytest.approx(1.0)
    assert means["layered"]["efficiency by error"] == pytest.approx(1.0)
    assert frames.mean_doubt(rows, "nma", "layered") == pytest.approx(math.sqrt(2.0) * 0.05 / 2.0)


def test_efficiencies_within_a_tenth_count_as_even():
    told = [frames.verdict(gain) for gain in (None, 0.5, 0.95, 1.09, 1.2)]
    assert told == ["-", "simulation", "even", "even", "adapter"]


def test_a_summary_has_a_row_for_each_bsdf_but_the_simulation():
    rows = settings.summary(
        {"scene": "preview"}, [{"layered": SIMULATION, "nma": ADAPTER, "principled": OTHER}]
    )
    assert [(row["scene"], row["BSDF"], row["verdict"]) for row in rows] == [
        ("preview", "nma", "adapter"),
        ("preview", "principled", "-"),
    ]
    assert rows[0]["doubt"] == pytest.approx(0.05)
    assert rows[1]["doubt"] is None


def noisy(rng, mean, deviation, count):
    return mean + deviation * rng.normal(size=(count, 60, 60, 3))


def test_the_error_is_variance_and_squared_bias_without_the_noise_of_the_converged_picture():
    rng = np.random.default_rng(1)
    parts = noisy(rng, 1.0, 0.6, 4)
    reference = frames.Converged(parts.mean(axis=0), parts.var(axis=0, ddof=1).mean() / 4)
    for bias in (0.0, 0.3):
        pictures = noisy(rng, 1.0 + bias, 0.5, 8)
        found = frames.figures(frames.Frames(pictures, np.ones(8), np.ones(8)), reference)
        # The converged picture has a variance of 0.09. The error would be 0.09 larger if the variance of the converged
        # picture were not subtracted.
        assert found["variance"] == pytest.approx(0.25, rel=0.03)
        assert found["error"] == pytest.approx(0.25 + bias**2, rel=0.05)
        assert 0.0 < found["doubt"] < 0.05


def test_parts_of_a_converged_picture_are_cached(tmp_path, monkeypatch):
    seeds = []

    def render(scene, spp, seed):
        seeds.append(seed)
        return np.full((2, 3, 3), float(len(seeds)), np.float32)

    monkeypatch.setattr(frames, "load_dict", lambda description: object())
    monkeypatch.setattr(frames, "render_passes", render)
    first = frames.converged({}, 64, tmp_path / "picture")
    assert len(set(seeds)) == frames.PARTS
    assert first.picture == pytest.approx(2.5)
    assert first.noise == pytest.approx(np.var([1.0, 2.0, 3.0, 4.0], ddof=1) / 4.0)
    next(tmp_path.glob("*_2.npy")).unlink()
    again = frames.converged({}, 64, tmp_path / "picture")
    assert len(seeds) == frames.PARTS + 1
    assert again.picture == pytest.approx((1 + 2 + 5 + 4) / 4)


def test_tables_are_markdown_with_numbers_aligned_right():
    text = frames.markdown(["what", "time"], [["layered", 1.0], ["principled", None], ["nma", 0.0123]])
    assert text.splitlines() == [
        "| what       |     time |",
        "|------------|---------:|",
        "| layered    |     1.00 |",
        "| principled |        - |",
        "| nma        | 1.23e-02 |",
    ]


def test_sample_counts_double_and_small_ones_have_more_runs():
    assert samples.levels(16) == [1, 2, 4, 8, 16]
    assert [samples.repeats(spp, 3) for spp in (1, 16, 32, 1024)] == [96, 6, 3, 3]


def test_flatness_is_the_largest_time_over_the_smallest():
    assert density.flatness({0.0: 2.0, 1.0: 3.0, 10.0: 2.5}) == 1.5


def test_lights_are_out_of_sight():
    camera = CAMERAS["hero"]
    forward = np.subtract(camera.target, camera.origin)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    half = np.tan(np.radians(camera.fov / 2.0))
    for towards, distance, _ in scenes.LIGHTS:
        place = np.array(scenes.LIGHTS_AROUND) + distance * np.array(towards) / np.linalg.norm(towards)
        seen = place - np.array(camera.origin)
        depth = seen @ forward
        edge = max(abs(seen @ right), abs(seen @ np.cross(right, forward))) - scenes.LIGHT_RADIUS
        assert depth < 0.0 or edge > half * depth


@pytest.mark.parametrize("name", scenes.SCENES)
def test_every_scene_renders_and_is_measured(name):
    import mitsuba as mi

    before = mi.variant()
    nma.render.use(frames.VECTORISED)
    try:
        described = {scenes.NOTHING: scenes.SCENES[name](scenes.DIFFUSE, (8, 6), 3)}
        found = frames.in_turns(described, 4, [0, 1])[scenes.NOTHING]
    finally:
        if before:
            mi.set_variant(before)
    assert found.pictures.shape == (2, 6, 8, 3)
    assert found.pictures.mean() > 0.0
    assert found.variance > 0.0
    assert found.seconds > 0.0


def test_the_command_without_a_name_lists_all_benches():
    lines = bench().stdout.splitlines()
    names = [line.split()[0] for line in lines]
    assert set(names) == {*PICTURED, *UNPICTURED}, (
        "tests/test_bench.py: PICTURED names the benches that draw their results, UNPICTURED all others; "
        "add a new bench to one of them"
    )
    assert all(len(line.split()) > 3 for line in lines)
    unknown = bench("no-such-bench")
    assert unknown.returncode != 0
    assert "no bench no-such-bench" in unknown.stderr


@pytest.mark.runs
@pytest.mark.parametrize("name", PICTURED + ["reciprocity"])
def test_every_bench_runs_in_its_quick_form(name, tmp_path):
    run = bench(name, "--quick", "--output", tmp_path)
    assert run.returncode == 0, run.stdout + run.stderr
    written = json.loads((tmp_path / f"{name}.json").read_text())
    assert written["machine"][0].startswith("machine")
    assert written["settings"]["quick"]
    assert (tmp_path / f"{name}.png").exists() == (name in PICTURED)
