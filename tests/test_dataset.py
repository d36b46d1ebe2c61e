"""Datasets on disk: they have the same bytes however they were made, and incomplete datasets give clear errors."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nma.errors import DatasetError
from nma.table import ISOTROPIC, dataset
from nma.table.dataset import Dataset, Settings, draw_params, simulate_block

SETTINGS = Settings("layered3", 24, 40_000, 7)

# Writes the dataset argv[1] in blocks of argv[2] materials. The process kills itself argv[4] seconds after argv[3]
# materials are done.
WORKER = """
import os, signal, sys, threading
from nma.table import dataset
from nma.table.dataset import Dataset, Settings

path, block, fatal, delay = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
timer = threading.Timer(delay, lambda: os.kill(os.getpid(), signal.SIGKILL))

def progress(done):
    if done >= fatal and not timer.is_alive():
        timer.start()

dataset._BLOCK = block
Dataset.create(path, Settings("layered3", 24, 40_000, 7)).write(progress)
"""


def start_worker(path: Path, block: int, fatal: int = 1000, delay: float = 0.0) -> subprocess.Popen:
    command = [sys.executable, "-c", WORKER, *map(str, (path, block, fatal, delay))]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def chunks(path: Path) -> dict[str, bytes]:
    """The bytes of every complete chunk of a dataset."""
    files = [p for p in (path / "c").rglob("*") if p.is_file() and not p.name.endswith(".partial")]
    return {str(p.relative_to(path)): p.read_bytes() for p in files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Dataset:
    """A dataset that one worker wrote without interruption."""
    data = Dataset.create(tmp_path_factory.mktemp("data") / "whole.zarr", SETTINGS)
    data.write()
    return data


@pytest.fixture
def copy(whole, tmp_path) -> Dataset:
    """A copy of the dataset that a test may damage."""
    shutil.copytree(whole.path, tmp_path / "copy.zarr")
    return Dataset.open(tmp_path / "copy.zarr")


def test_a_dataset_holds_the_tables_of_its_settings(whole):
    tables = whole.load()
    assert tables.values.shape == (24, *ISOTROPIC.shape)
    assert tables.values.dtype == np.float16
    assert (tables.walks == 40_000).all()
    assert tables.error is None
    some = [20, 3]
    direct = simulate_block(SETTINGS, some)
    np.testing.assert_array_equal(direct.values.astype(np.float16), tables.values[some])
    np.testing.assert_array_equal(direct.params, tables.params[some])
    np.testing.assert_array_equal(whole.load(some).values, tables.values[some])
    albedo = tables.albedo()
    assert (albedo > 0).all()
    assert albedo.max() <= 1.0 + 1e-3


def test_blocks_do_not_change_the_result(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(dataset, "_BLOCK", 5)
    by_fives = Dataset.create(tmp_path / "five.zarr", SETTINGS)
    by_fives.write()
    assert chunks(by_fives.path) == chunks(whole.path)
    # A killed run must not lose many walks, so materials with many walks are simulated in smaller blocks.
    monkeypatch.setattr(dataset, "_BLOCK_WALKS", 40_000)
    sizes = []
    monkeypatch.setattr(
        dataset, "simulate_block", lambda s, todo: sizes.append(len(todo)) or simulate_block(s, todo)
    )
    one = Dataset.create(tmp_path / "one.zarr", Settings("layered3", 2, 40_000, 7))
    one.write()
    assert sizes == [1, 1]
    assert chunks(one.path).items() <= chunks(whole.path).items()


def test_two_workers_write_one_dataset(whole, tmp_path):
    path = tmp_path / "shared.zarr"
    workers = [start_worker(path, block) for block in (2, 3)]
    results = [worker.communicate(timeout=120) for worker in workers]
    assert [worker.returncode for worker in workers] == [0, 0], results
    assert chunks(path) == chunks(whole.path)


@pytest.mark.slow
def test_a_run_killed_three_times_and_resumed_equals_an_uninterrupted_one(whole, tmp_path):
    """Each run ends by SIGKILL, at a random moment after some more materials are done."""
    path, moments, missing = tmp_path / "killed.zarr", random.Random(1), 24
    for _ in range(3):
        fatal = 24 - missing + moments.randint(1, 4)
        worker = start_worker(path, 1, fatal, moments.uniform(0.0, 0.02))
        worker.communicate(timeout=120)
        assert worker.returncode == -signal.SIGKILL
        before, missing = missing, len(Dataset.open(path).missing())
        assert 0 < missing < before
    resumed = start_worker(path, 4)
    _, complaints = resumed.communicate(timeout=120)
    assert resumed.returncode == 0, complaints
    assert chunks(path) == chunks(whole.path)
    np.testing.assert_array_equal(Dataset.open(path).load().values, whole.load().values)


def test_a_chunk_that_was_not_finished_does_not_count(copy):
    """A killed run leaves a temporary file beside the chunk's own path."""
    chunk = Path(copy._chunk(5))
    chunk.rename(chunk.with_suffix(".0123456789abcdef.partial"))
    assert copy.missing().tolist() == [5]
    done = []
    copy.write(done.append)
    assert done[-1] == 24
    assert copy.missing().tolist() == []


def test_a_writer_that_fails_leaves_no_chunk(tmp_path, monkeypatch):
    """A chunk does not exist if writing it failed, because zarr writes files atomically.

    A failure means that a new version of zarr no longer writes atomically.
    """
    data = Dataset.create(tmp_path / "full.zarr", Settings("layered3", 1, 40, 0))

    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(DatasetError, match="cannot write.*No space left.*again to continue"):
        data.write()
    assert data.missing().tolist() == [0]


def test_black_materials_are_stored(tmp_path):
    """zarr stores no chunk of zeros unless told to, and a material without a chunk counts as missing."""
    data = Dataset.create(tmp_path / "x.zarr", Settings("layered3", 2, 1, 0))
    data._store([0, 1], np.zeros((2, *ISOTROPIC.shape), np.float16))
    assert not len(data.missing())
    assert not data.load().values.any()


def test_progress_counts_what_others_did(copy):
    for index in (1, 2, 23):
        os.remove(copy._chunk(index))
    reports = []
    copy.write(reports.append)
    assert reports == sorted(reports)
    assert reports[0] >= 21
    assert reports[-1] == 24


def test_materials_depend_on_seed_and_index_alone():
    params = draw_params(SETTINGS, range(24))
    np.testing.assert_array_equal(draw_params(SETTINGS, [9, 2]), params[[9, 2]])
    more = Settings("layered3", 1000, 40, 7)
    np.testing.assert_array_equal(draw_params(more, range(24)), params)
    other = draw_params(Settings("layered3", 24, 40_000, 8), range(24))
    assert (other[:, 0] != params[:, 0]).all()


@pytest.mark.parametrize("changed", [0, 23])
def test_a_version_that_draws_another_first_or_last_material_is_refused(tmp_path, monkeypatch, changed):
    Dataset.create(tmp_path / "old.zarr", SETTINGS)

    def other(settings, indices):
        return draw_params(settings, indices) + 0.001 * (np.array(indices) == changed)[:, None]

    monkeypatch.setattr(dataset, "draw_params", other)
    with pytest.raises(DatasetError, match="drew other parameters"):
        Dataset.open(tmp_path / "old.zarr")


def test_a_missing_chunk_is_refused_with_the_command_that_completes_it(copy):
    for index in (3, 4):
        os.remove(copy._chunk(index))
    with pytest.raises(DatasetError) as caught:
        copy.load()
    message = str(caught.value)
    assert "material 3 is missing (2 are missing in all); run `nma dataset layered3 " in message
    assert "\n" not in message
    assert copy.load([0, 1]).values.shape[0] == 2
    copy.write()
    assert copy.missing().size == 0


DAMAGES = {
    "flipped": lambda content: content[:1000] + bytes([content[1000] ^ 1]) + content[1001:],
    "flipped checksum": lambda content: content[:-1] + bytes([content[-1] ^ 1]),
    "truncated": lambda content: content[: len(content) // 2],
    "one byte short": lambda content: content[:-1],
    "empty": lambda content: b"",
    "longer": lambda content: content + b"x",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_chunk_is_refused_with_what_mends_it(copy, damage):
    chunk = Path(copy._chunk(6))
    before = chunk.read_bytes()
    chunk.write_bytes(DAMAGES[damage](before))
    with pytest.raises(DatasetError) as caught:
        copy.load()
    message = str(caught.value)
    assert f"chunk {chunk} is damaged" in message
    assert message.endswith("delete that file and run `nma dataset` again")
    assert "\n" not in message
    chunk.unlink()
    copy.write()
    assert chunk.read_bytes() == before


@pytest.mark.parametrize(
    "change", [{"walks": 80_000}, {"seed": 8}, {"materials": 25}, {"population": "range"}]
)
def test_other_settings_are_refused(whole, change):
    with pytest.raises(
        DatasetError, match=f"{next(iter(change))} .*asked for.*choose another folder"
    ) as caught:
        Dataset.create(whole.path, Settings(**({**SETTINGS.__dict__} | change)))
    assert "\n" not in str(caught.value)
    assert Dataset.create(whole.path, SETTINGS).missing().size == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"materials": 0}, "at least one material"),
        ({"walks": 0}, "at least one material"),
        ({"seed": -1}, "a seed of at least 0"),
        ({"population": "gold"}, "population is one of mixed, .*'gold'"),
        ({"population": "unseen_metals"}, "population is one of"),
    ],
)
def test_settings_that_make_no_dataset_are_refused(change, message):
    with pytest.raises(DatasetError, match=message):
        Settings(**({**SETTINGS.__dict__} | change))


def test_a_material_beyond_the_last_is_refused(whole):
    for index in (24, -1):
        with pytest.raises(DatasetError, match=f"has 24 materials, but no material {index}"):
            whole.load([index])


def test_a_dataset_without_a_sound_description_is_refused_with_advice(copy):
    (copy.path / "zarr.json").write_text('{"shape": [\n')
    with pytest.raises(
        DatasetError, match="is not a dataset.*damaged.*deleted and made again.*`nma dataset CLASS"
    ) as caught:
        Dataset.create(copy.path, SETTINGS)
    assert "\n" not in str(caught.value)


def test_what_is_no_dataset_is_refused(tmp_path):
    (tmp_path / "file").write_text("no folder")
    for path in (tmp_path / "nowhere", tmp_path, tmp_path / "file"):
        with pytest.raises(DatasetError, match="is not a dataset of tables.*`nma dataset CLASS") as caught:
            Dataset.open(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(DatasetError, match="file"):
        Dataset.create(tmp_path / "file", SETTINGS)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("nma_dataset", None, "is not a dataset of tables"),
        ("nma_dataset", {**SETTINGS.__dict__, "format": 99}, "has format 99"),
        # A later format may have more fields. The data may be good, so nothing advises to delete the data.
        (
            "nma_dataset",
            {**SETTINGS.__dict__, "format": 2, "colour": 1},
            "has format 2, .* use the version that made",
        ),
        (
            "nma_dataset",
            {**SETTINGS.__dict__, "colour": 1},
            "do not fit .*colour.*; use the version that made",
        ),
        (
            "nma_dataset",
            {**SETTINGS.__dict__, "materials": 24.0},
            "setting materials is a whole number; got 24.0",
        ),
        ("nma_dataset", {**SETTINGS.__dict__, "seed": 0.0}, "setting seed is a whole number; got 0.0"),
        ("nma_dataset", {**SETTINGS.__dict__, "walks": True}, "setting walks is a whole number; got True"),
        (
            "nma_dataset",
            {**SETTINGS.__dict__, "class_name": "\x1b[31m" + "x" * 100_000},
            r"^[ -~]{1,600}; this version simulates [ -~]{1,100}$",
        ),
        (
            "nma_dataset",
            {**SETTINGS.__dict__, "class_name": "paint"},
            "is of class 'paint'; this version simulates",
        ),
        ("nma_params", "0123456789abcdef", "drew other parameters"),
    ],
)
def test_datasets_of_other_versions_are_refused(copy, key, value, message):
    file = copy.path / "zarr.json"
    header = json.loads(file.read_text())
    header["attributes"][key] = value
    file.write_text(json.dumps(header))
    with pytest.raises(DatasetError, match=message) as caught:
        Dataset.open(copy.path)
    assert "\n" not in str(caught.value)
