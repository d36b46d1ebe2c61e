"""The command-line option `--set` changes the parameters of a material."""

import numpy as np
import pytest
from PIL import Image

from nma import materials
from nma.cli.reading import change_of
from nma.errors import MaterialError


@pytest.mark.parametrize(
    ("text", "change"),
    [
        ("alpha_top=.2", ("alpha_top", 0.2)),
        ("albedo=.9,.1,.1", ("albedo", [0.9, 0.1, 0.1])),
        ("albedo=#3366ee", ("albedo", "#3366ee")),
        ("conductor=Ag", ("conductor", "Ag")),
        ("sigma_t=wear.png", ("sigma_t", {"texture": "wear.png"})),
        ("sigma_t=wear, old.png", ("sigma_t", {"texture": "wear, old.png"})),
        ("sigma_t=orm.png,channel=g", ("sigma_t", {"texture": "orm.png", "channel": "g"})),
        (
            "albedo=a.png,raw=true,uv_scale=4,scale=.5",
            ("albedo", {"texture": "a.png", "raw": True, "uv_scale": 4.0, "scale": 0.5}),
        ),
    ],
)
def test_the_text_of_set_becomes_the_value_of_a_material_file(text, change):
    assert change_of(text) == change


def test_a_coloured_image_may_be_set_by_a_channel(tmp_path):
    image, gold = tmp_path / "orm.png", materials.load("gold-red-lacquer")
    Image.fromarray(np.full((4, 4, 3), (255, 25, 0), np.uint8)).save(image)
    changed = gold.changed(dict([change_of(f"sigma_t={image},channel=r")]), "--set")
    np.testing.assert_array_equal(changed.textures["sigma_t"].read(), 1.0)
    with pytest.raises(MaterialError, match="--set, sigma_t: channel is 'x'"):
        gold.changed(dict([change_of(f"sigma_t={image},channel=x")]), "--set")
