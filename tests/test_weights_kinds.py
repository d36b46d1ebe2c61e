"""The readers of weights files in Python and in C++ refuse the same faulty headers."""

import json
import math
import re
import struct

import pytest
from weights_cases import FIRST, changed, header_of, packed, ranged, stored

from nma.adapter import Adapter
from nma.errors import WeightsError
from nma.native.runtime import Runtime


def written(old, new):
    """Returns a weights file in whose metadata the text `old` is replaced by `new`, once."""
    header, about, data = header_of(FIRST)
    text = json.dumps(about)
    assert old in text
    return packed(header, text.replace(old, new, 1), data)


def without(name):
    """Returns a weights file whose metadata lacks a field."""
    header, about, data = header_of(FIRST)
    del about[name]
    return packed(header, about, data)


def tensor_twice():
    """Returns a weights file whose header has the entry of one tensor twice."""
    data = stored(FIRST)
    size = struct.unpack("<Q", data[:8])[0]
    entry = '"layer0.bias": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}, '
    text = ("{" + entry).encode() + data[9 : 8 + size]
    return struct.pack("<Q", len(text)) + text + data[8 + size :]


KINDS = {
    "a flag is 1": ranged("target", 2, in_plane=1),
    "a flag is null": ranged("target", 2, in_plane=None),
    "a flag is text": changed(FIRST, bounded="true"),
    "bounded is 1": changed(FIRST, bounded=1),
    "bounded is null": changed(FIRST, bounded=None),
    "directional is 1": changed(FIRST, directional=1),
    "reciprocal is null": changed(FIRST, reciprocal=None),
    "format is true": changed(FIRST, format=True),
    "format is 1.0": changed(FIRST, format=1.0),
    "instances is 2.0": changed(FIRST, instances=2.0),
    "instances is text": changed(FIRST, instances="2"),
    "hidden has fractions": changed(FIRST, hidden=[32.0, 32.0, 32.0]),
    "hidden has truths": changed(FIRST, hidden=[True, 32, 32]),
    "a size is true": ranged("parameters", 0, size=True),
    "a size is 3.0": ranged("target", 0, size=3.0),
    "a low end is false": ranged("target", 2, low=False),
    "a low end is missing": written(
        '"name": "metallic", "size": 1, "low": 0.0,', '"name": "metallic", "size": 1,'
    ),
    "a scale is null": ranged("target", 2, scale=None),
    "a name is a list": ranged("target", 2, name=["metallic"]),
    "the class is a number": changed(FIRST, class_name=3),
    "the target is an object": changed(FIRST, target={}),
    "the training is a list": changed(FIRST, training=[]),
    "skip is 1": changed(FIRST, skip=1),
    "skip is null": changed(FIRST, skip=None),
    "the last layer does not read the inputs": changed(FIRST, skip=True),
    "the interface is null": changed(FIRST, interface=None),
    "the interface is text": changed(FIRST, interface="alpha_top"),
    "the interface is an object": changed(FIRST, interface={"alpha_top": "eta_top"}),
    "the interface has one name": changed(FIRST, interface=["alpha_top"]),
    "the interface has three names": changed(FIRST, interface=["alpha_top", "eta_top", "sigma_t"]),
    "the interface has numbers": changed(FIRST, interface=[0, 2]),
    "the interface has lists": changed(FIRST, interface=[["alpha_top"], ["eta_top"]]),
    "the interface has an unknown name": changed(FIRST, interface=["alpha_top", "eta"]),
    "the interface has a colour": changed(FIRST, interface=["alpha_top", "eta_conductor"]),
    "the interface has its names in the wrong order": changed(FIRST, interface=["eta_top", "alpha_top"]),
    "a width may be 0": changed(FIRST, interface=["sigma_t", "eta_top"]),
    "an interface is missing": ranged("target", 5, name="veil"),
    "an encoding needs the direction": changed(FIRST, encoding="layered3_bounce", directional=False),
    "a field of the target is unknown": ranged("target", 2, colour=1),
    "a field is unknown": changed(FIRST, colour=1),
    "the format is missing": without("format"),
    "the direction is missing": without("directional"),
    "a number is NaN": changed(FIRST, training={"loss": math.nan}),
    "a number is too large": written('"training": {', '"training": {"loss": 1e400, '),
    "a number starts with 0": written('"low": 0.0', '"low": 00.0'),
    "a number has a plus": written('"low": 0.0', '"low": +0.0'),
    "a text has a tab": written("layered3", "lay\tered3"),
}


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize("fault", KINDS)
def test_both_readers_refuse_values_of_another_kind(tmp_path, fault):
    """A flag, a number, a text or a list that has another kind of JSON value is refused in Python and in C++."""
    path = tmp_path / "bad.safetensors"
    path.write_bytes(KINDS[fault])
    for reader in (Adapter.load, Runtime):
        with pytest.raises(WeightsError, match=re.escape(f"{path}: ")):
            reader(path)


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize(
    "fields",
    [
        {"interface": ["alpha_top", "eta_top"]},
        {"interface": [], "skip": False},
        {"encoding": "layered3_bounce", "interface": ["alpha_bottom", "eta_top"]},
    ],
)
def test_both_readers_accept_an_interface_of_a_width_and_an_index(tmp_path, fields):
    path = tmp_path / "good.safetensors"
    path.write_bytes(changed(FIRST, **fields))
    assert (Adapter.load(path).interface or ()) == tuple(fields["interface"])
    Runtime(path)


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize(
    "key, data",
    [
        ("in_plane", written('"in_plane": false', '"in_plane": true, "in_plane": false')),
        ("instances", written('"instances": 2', '"instances": 2, "instances": 2')),
        ("layer0.bias", tensor_twice()),
    ],
)
def test_both_readers_refuse_a_key_that_occurs_twice(tmp_path, key, data):
    path = tmp_path / "bad.safetensors"
    path.write_bytes(data)
    for reader in (Adapter.load, Runtime):
        with pytest.raises(WeightsError) as told:
            reader(path)
        assert (
            str(told.value)
            == f"{path}: the header has the key '{key}' twice; copy the file again or train again"
        )


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize("name", ["\x1b[31mred\n", "x" * 100_000])
def test_names_of_a_file_are_shortened_and_have_no_escape_codes(tmp_path, name):
    path = tmp_path / "bad.safetensors"
    for reader, faults in (
        (Adapter.load, ("class_name", "encoding", "dialect")),
        (Runtime, ("encoding", "dialect")),
    ):
        for fault in faults:
            path.write_bytes(changed(FIRST, **{fault: name}))
            with pytest.raises(WeightsError) as told:
                reader(path)
            assert str(told.value).isprintable() and len(str(told.value)) < 400, (reader, fault)
