"""`nma demo` shows reference and adapter side by side."""

import re
import sys

import pytest

from nma.images.io import read_image


@pytest.mark.slow
def test_demo_draws_two_rows_and_prints_six_lines(nma, untrained, tmp_path, monkeypatch):
    """The demonstration works without scikit-image, the package for SSIM, which takes longest to install."""
    monkeypatch.setitem(sys.modules, "skimage", None)
    options = ("--size", 16, "--spp", 1, "--runs", 2, "--reference-spp", 2, "--adapter", untrained)
    code, out, err = nma("demo", "-o", tmp_path / "demo.png", *options)
    assert code == 0, err
    assert [len(re.findall(f"^{bsdf} ", out, re.M)) for bsdf in ("principled", "layered", "nma")] == [2, 2, 2]
    height, width, _ = read_image(tmp_path / "demo.png").shape
    assert height > 2 * 16 and width > 3 * 16
    shown = [line for line in err.replace("\n", " ").split(str(tmp_path / "demo.png")) if ": " in line]
    assert ["figures" in text for text in shown[-4:]] == [False, False, True, True]
