"""`nma compare` measures the difference of two images, or of the pictures of an adapter and a simulation."""

import json

import numpy as np
import pytest

from nma.images.io import write_exr


def test_compare_prints_the_errors_between_two_images(nma, tmp_path):
    image = np.random.default_rng(0).random((16, 16, 3), dtype=np.float32)
    a, b = write_exr(tmp_path / "a.exr", image), write_exr(tmp_path / "b.exr", image * 1.1)
    code, out, _ = nma("compare", a, b, "--json", "-o", tmp_path / "difference.png")
    assert code == 0
    errors = json.loads(out)
    assert tuple(errors) == ("l1", "l2", "mape", "smape", "mrse", "ssim", "flip_hdr", "flip_ldr")
    assert errors["l1"] == pytest.approx(0.1 * image.mean(), rel=1e-5)
    assert (tmp_path / "difference.png").is_file()
    assert "flip_hdr" in nma("compare", a, b)[1]


@pytest.mark.slow
def test_compare_prints_the_errors_of_an_adapter_and_the_noise_of_its_reference(nma, untrained):
    options = ("--adapter", untrained, "--size", 16, "--spp", 2, "--json")
    code, out, err = nma("compare", "gold-red-lacquer", *options)
    assert code == 0, err
    assert tuple(json.loads(out)["noise"]) == tuple(json.loads(out))[:-1]
