"""`nma data` lists the public measurements and checks a user's copies of them."""

import shutil
from functools import partial

import numpy as np
import pytest

from nma.errors import SourceError
from nma.sources import catalogue, merl
from nma.sources.catalogue import MEASUREMENTS
from nma.sources.merl import Merl


@pytest.fixture
def data(nma):
    """Runs `nma data ARGUMENTS` and returns (exit status, stdout, stderr)."""
    return partial(nma, "data")


@pytest.fixture
def uniform(tmp_path):
    """A MERL file of a uniform material."""
    path = tmp_path / "uniform.binary"
    Merl(np.ones((3, *merl.SHAPE))).save(path)
    return path


def test_all_measurements_are_listed_with_their_origin_terms_and_files(data):
    code, out, err = data()
    assert (code, err) == (0, "")
    assert [d.name for d in MEASUREMENTS] == ["MERL", "RGL", "NBRDF-MERL", "NBRDF-RGL"]
    for measured in MEASUREMENTS:
        for text in (
            measured.name,
            measured.kind,
            measured.origin,
            measured.paper,
            measured.licence,
            measured.files,
        ):
            assert text in out
        for name, (size, checksum) in measured.known.items():
            assert f"{name}: {size:,} bytes, SHA-256 {checksum}" in out


def test_a_reconstruction_is_never_called_a_measurement():
    for measured in MEASUREMENTS:
        assert measured.kind.startswith(
            "neural reconstruction" if "NBRDF" in measured.name else "measurement"
        )


def test_sound_copies_are_as_known(data, measurements):
    code, out, _ = data("check", measurements)
    assert code == 0
    lines = out.splitlines()
    known = [name for measured in MEASUREMENTS for name in measured.known]
    assert len(lines) >= len(known) == 6
    for name in known:
        (line,) = (line for line in lines if name in line)
        assert line.startswith("ok") and line.endswith("sound; its SHA-256 is that of the original")


def test_a_file_without_a_known_checksum_is_read(data, uniform):
    code, out, _ = data("check", uniform)
    assert (code, out) == (0, f"ok     MERL        {uniform}: sound; its checksum is not known here\n")


def test_faults_are_named_file_by_file(data, uniform, measurements):
    folder = uniform.parent
    whole = uniform.read_bytes()
    (folder / "cut.binary").write_bytes(whole[:-1])
    (folder / "empty.bsdf").write_bytes(b"")
    paper = (measurements / "rgl" / "paper_white_rgb.bsdf").read_bytes()
    (folder / "paper_white_rgb.bsdf").write_bytes(paper[:-1])
    (folder / "sub").mkdir()
    shutil.copy(measurements / "rgl" / "cg_sunflower_rgb.bsdf", folder / "sub" / "mine_rgb.bsdf")
    # A readable file of the right size that differs from the original file in one bit.
    changed = bytearray(paper)
    changed[200_000] ^= 1
    (folder / "sub" / "paper_white_rgb.bsdf").write_bytes(changed)
    (folder / "merl_nbrdf_weights.npz").write_bytes(b"damaged")
    np.savez(folder / "networks.npz", names=np.array(["a"]), weights=np.zeros((1, 3)))
    # `nma data check` ignores files of other kinds.
    np.savez(folder / "reference.npz", table=np.zeros(3))
    (folder / "notes.txt").write_text("nothing")
    code, out, err = data("check", folder)
    assert (code, err) == (1, "")
    found = {line.split(f"{folder}/")[1]: line.split()[0] for line in out.splitlines()}
    assert found == {
        "cut.binary: truncated, 34,992,011 bytes instead of 34,992,012; copy the file again": "FAULT",
        "empty.bsdf: empty; RGL's materials are files that end in _rgb.bsdf": "FAULT",
        "merl_nbrdf_weights.npz: 7 bytes instead of 256,573; copy the file again": "FAULT",
        "networks.npz: names (1,) and weights (1, 3) are not (n,) and (n, 675); copy the file again": "FAULT",
        "paper_white_rgb.bsdf: 658,927 bytes instead of 658,928; copy the file again": "FAULT",
        "sub/mine_rgb.bsdf: sound; its checksum is not known here": "ok",
        "sub/paper_white_rgb.bsdf: sound, but not the original file: its SHA-256 differs": "FAULT",
        "uniform.binary: sound; its checksum is not known here": "ok",
    }


def test_what_is_no_measurement_is_said_to_be_none(data, tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    code, out, _ = data("check", tmp_path / "notes.txt")
    assert (code, out.split()[0]) == (1, "FAULT")
    assert "no file of known measurements (.binary, .bsdf, .npz)" in out
    for path, message in (
        (tmp_path, "holds no file of known measurements"),
        (tmp_path / "no", "no such file"),
    ):
        with pytest.raises(SourceError, match=message):
            list(catalogue.check(path))
        code, out, err = data("check", path)
        assert (code, out) == (1, "")
        assert err.startswith("nma: ") and err.count("\n") == 1 and str(path) in err
