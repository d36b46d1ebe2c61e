"""Image files, tone mapping, metrics, difference pictures and contact sheets."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nma.errors import MissingDependencyError
from nma.images import io
from nma.images.io import ImageError, read_image, tonemap, write_exr, write_png
from nma.images.metrics import METRICS, compare_images, difference_image, errors, flip_map
from nma.images.sheet import Row, contact_sheet


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    """A smooth picture with values from 0.02 to about 4."""
    x, y = np.meshgrid(np.linspace(0.0, 1.0, 48), np.linspace(0.0, 1.0, 32))
    return np.stack([0.02 + x, 0.02 + y * y, 0.02 + 4.0 * x * y], axis=-1).astype(np.float32)


def test_equal_images_have_no_error(picture):
    result = compare_images(picture, picture)
    assert tuple(result) == METRICS
    assert result.pop("ssim") == pytest.approx(1.0, abs=1e-6)
    assert result == dict.fromkeys(result, pytest.approx(0.0, abs=1e-6))


def test_plain_errors_follow_their_formulas():
    """The errors equal values that are computed by hand with eps = .01.

    All pixels of the image are 3, and all pixels of the reference image are 1.
    """
    result = errors(np.full((2, 2, 3), 3.0), np.full((2, 2, 3), 1.0))
    expected = {"l1": 2.0, "l2": 4.0, "mape": 2 / 1.01, "smape": 4 / 4.01, "mrse": 4 / 1.01}
    assert result == pytest.approx(expected, rel=1e-9)


def test_errors_grow_with_the_difference(picture):
    """Every metric but SSIM is larger if a picture is brighter by 30 % than if it is brighter by 5 %.

    SSIM ignores most of a change of brightness.
    """
    small, large = (compare_images(picture * factor, picture) for factor in (1.05, 1.3))
    assert all(large[name] > small[name] > 0.0 for name in METRICS if name != "ssim")


def test_ssim_sees_noise_rather_than_brightness(picture):
    noise = 0.2 * np.random.default_rng(0).normal(size=picture.shape)
    assert (
        compare_images(picture + noise, picture)["ssim"]
        < 0.8
        < compare_images(picture * 1.05, picture)["ssim"]
    )


def test_ldr_metrics_see_differences_beyond_white_only_at_lower_exposure(picture):
    """The LDR metric of two pictures is zero if they differ only in values above 1, because these values are clipped.

    At a lower exposure, the LDR metric shows the difference.
    """
    bright = picture + 2.0
    clipped = compare_images(bright * 1.2, bright)
    lowered = compare_images(bright * 1.2, bright, ldr_exposure=-4.0)
    assert clipped["flip_ldr"] < 1e-6
    assert lowered["flip_ldr"] > 0.02
    assert clipped["flip_hdr"] == lowered["flip_hdr"] > 0.02


@pytest.mark.parametrize("level", [0.0, 0.3, 20.0])
def test_flip_survives_black_and_flat_references(level):
    reference = np.full((12, 12, 3), level, dtype=np.float32)
    assert flip_map(reference, reference, hdr=True).max() == pytest.approx(0.0, abs=1e-6)
    assert flip_map(reference + 0.5 * level + 0.5, reference, hdr=True).mean() > 0.05


def test_negative_values_count_as_black(picture):
    assert np.isfinite(list(compare_images(picture - 0.2, picture).values())).all()


@pytest.mark.parametrize("call", [compare_images, errors, flip_map, difference_image])
def test_unfit_images_are_refused(call, picture):
    broken = picture.copy()
    broken[3, 5] = np.nan
    with pytest.raises(ImageError, match="x=5, y=3"):
        call(broken, picture)
    with pytest.raises(ImageError, match="47 x 32 and 48 x 32"):
        call(picture[:, 1:], picture)
    with pytest.raises(ImageError, match="reference image"):
        call(picture, picture[..., 0])


def test_too_small_images_are_refused_for_ssim():
    with pytest.raises(ImageError, match="11 x 11"):
        compare_images(np.ones((8, 8, 3)), np.ones((8, 8, 3)))


def test_the_error_of_a_missing_package_names_the_extra(picture, monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(
        MissingDependencyError, match=r"in a checkout of this project run: pip install '\.\[compare\]'"
    ):
        flip_map(picture, picture)


def test_difference_pictures(picture):
    brighter = picture + 0.1
    none, signed = difference_image(picture, picture), difference_image(brighter, picture, kind="signed")
    assert none.shape == picture.shape and none.dtype == np.uint8
    assert none.max() <= 4  # the darkest colour of the colour map `magma` is almost black
    assert (signed[..., 0] > signed[..., 2]).all()
    assert difference_image(brighter, picture, kind="absolute", scale=0.1).mean() > 150
    with pytest.raises(ImageError, match="unknown kind"):
        difference_image(picture, picture, kind="relative")


def test_tonemap_is_srgb():
    """The tone curve converts linear values to the known sRGB values, and clips values below 0 or above 1.

    One stop of exposure doubles the linear values.
    """
    linear = np.array([-1.0, 0.0, 0.001, 0.18, 0.5, 1.0, 9.0])
    expected = np.array([0.0, 0.0, 0.01292, 0.46135612, 0.73535698, 1.0, 1.0])
    np.testing.assert_allclose(tonemap(linear), expected, atol=1e-6)
    np.testing.assert_allclose(tonemap(linear / 2.0, exposure=1.0), expected, atol=1e-6)


def test_the_shoulder_is_smooth_and_keeps_values_below_it():
    x = np.linspace(0.0, 3.0, 3001)
    plain, soft = tonemap(x), tonemap(x, shoulder=0.8)
    np.testing.assert_array_equal(soft[x <= 0.8], plain[x <= 0.8])
    assert (np.diff(soft) >= 0.0).all() and soft.max() <= 1.0
    slope = np.diff(soft) / np.diff(x)
    assert np.abs(np.diff(slope)[790:810]).max() < 0.01
    with pytest.raises(ImageError):
        tonemap(x, shoulder=0.0)


def test_exr_keeps_values(tmp_path: Path, picture):
    np.testing.assert_array_equal(
        read_image(write_exr(tmp_path / "new" / "a.exr", picture * 100.0)), picture * 100.0
    )


def test_exr_files_are_written_and_read_with_one_thread(tmp_path: Path):
    """A process with one thread writes and reads an EXR file.

    If this test hangs, OpenEXR is waiting for a second thread.
    """
    program = (
        "import drjit, sys; drjit.set_thread_count(1)\n"
        "from nma.images.io import read_image, write_exr\n"
        "print(read_image(write_exr(sys.argv[1], [[[1.0, 2.0, 3.0]]])).tolist(), drjit.thread_count())"
    )
    words = [sys.executable, "-c", program, str(tmp_path / "one.exr")]
    run = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    assert run.stdout == "[[[1.0, 2.0, 3.0]]] 1\n"


def test_png_holds_the_tonemapped_picture(tmp_path: Path, picture):
    path = write_png(tmp_path / "a.png", picture, exposure=-1.0, shoulder=1.0)
    shown = np.asarray(Image.open(path))
    np.testing.assert_array_equal(shown, io.to_8bit(tonemap(picture, exposure=-1.0)))
    np.testing.assert_allclose(read_image(path), np.minimum(picture / 2.0, 1.0), atol=0.01)


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path: Path, picture, monkeypatch):
    path = write_png(tmp_path / "a.png", picture)
    before = path.read_bytes()

    def fail(*_args, **_options):
        raise OSError("disk full")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        write_png(path, picture * 2.0)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_unreadable_images_are_refused(tmp_path: Path, picture):
    with pytest.raises(ImageError, match="does not exist"):
        read_image(tmp_path / "none.exr")
    (tmp_path / "bad.exr").write_bytes(b"not an image")
    with pytest.raises(ImageError, match="cannot be read"):
        read_image(tmp_path / "bad.exr")
    with pytest.raises(ImageError, match="NaN"):
        write_png(tmp_path / "nan.png", picture * np.nan)


def test_contact_sheet_shows_the_pictures(tmp_path: Path, picture):
    bytes_ = io.to_8bit(tonemap(picture, shoulder=0.8))
    rows = [Row("first", [picture, bytes_], ["2.1 s\nvariance .01"]), Row("second", [picture, picture])]
    sheet = contact_sheet(
        tmp_path / "a.png", rows, ["Left", "Right"], title="Title", table=[["", "a"], ["x", "1"]], note="note"
    )
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), sheet)
    corners = np.argwhere((sheet == bytes_[0, 0]).all(axis=2))
    height, width = bytes_.shape[:2]
    found = sum(np.array_equal(sheet[y : y + height, x : x + width], bytes_) for y, x in corners)
    assert found == 4


def test_words_wider_than_a_picture_make_room(tmp_path: Path, picture):
    short = [Row("r", [picture, picture], ["", ""])]
    long = [Row("r", [picture, picture], ["a caption as long as this one", ""])]
    narrow, wide = (contact_sheet(tmp_path / "a.png", rows, ["a", "b"]) for rows in (short, long))
    heading = contact_sheet(tmp_path / "a.png", short, ["a heading that is as long as this one", "b"])
    assert narrow.shape[1] < wide.shape[1] < heading.shape[1]


@pytest.mark.parametrize("fault", ["empty", "count", "size"])
def test_contact_sheet_refuses(fault, tmp_path: Path, picture):
    rows = {
        "empty": [],
        "count": [Row("r", [picture])],
        "size": [Row("r", [picture, picture[1:]])],
    }[fault]
    with pytest.raises(ImageError):
        contact_sheet(tmp_path / "a.png", rows, ["one", "two"])


def test_layers_of_an_exr_keep_their_names_and_the_colours_are_found(tmp_path):
    image = np.random.default_rng(0).random((4, 5, 4), dtype=np.float32)
    path = write_exr(tmp_path / "layers.exr", image, ["R", "G", "B", "depth.T"])
    np.testing.assert_array_equal(read_image(path), image[..., :3])
