"""Files of the C++ runtime: weights, refused where they make no sense, and headers generated from the package."""

import importlib.util
import json
import re
import struct
import sys
import textwrap
from pathlib import Path
from types import ModuleType

import pytest

from nma.errors import WeightsError
from nma.export.classes import classes
from nma.export.cpp import cpp, print_function
from nma.export.functions import Unsupported, parsed
from nma.runtime import Runtime

ROOT = Path(__file__).parent.parent
IN_PLANE = {"name": "metallic", "size": 1, "low": 0, "high": 1, "scale": "linear", "in_plane": True}


def stored(name):
    return (ROOT / "nma/adapters" / f"{name}.safetensors").read_bytes()


def changed(name, **fields):
    """A weights file whose metadata differ."""
    data = stored(name)
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + size])
    about = json.loads(header["__metadata__"]["nma"]) | fields
    header["__metadata__"]["nma"] = json.dumps(about)
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data[8 + size :]


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize(
    "data, message",
    [
        (b"", "too short"),
        (stored("layered3-3x32")[:1000], "truncated"),
        (stored("layered3-3x32")[:-4], "does not lie within the file"),
        (b"\xff" * 100, "truncated"),
        (struct.pack("<Q", 2) + b"{}", "__metadata__"),
        (struct.pack("<Q", 3) + b'{"a', "open string"),
        (struct.pack("<Q", 60) + b"[" * 60, "nested too deep"),
        (changed("layered3-3x32", format=2), "format"),
        (changed("layered3-3x32", encoding="new"), "unknown input encoding 'new'"),
        (changed("layered3-3x32", dialect="cycles"), "dialect 'cycles'"),
        (changed("layered3-3x32", instances=1), "does not fit its description"),
        (changed("layered3-3x32", hidden=[32, 32, 31]), "hidden layers"),
        (changed("layered3-3x32", hidden="many"), "'hidden'"),
        (changed("layered3-3x32", target=[]), "does not fit its description"),
        (changed("layered3-3x32", encoding="azimuth"), "does not fit its description"),
        (changed("layered3-3x32", encoding="azimuth", target=[IN_PLANE]), "holds in the plane of incidence"),
        (changed("layered3-3x32", encoding="azimuth", directional=False), "ignores the direction"),
    ],
)
def test_files_that_make_no_sense_are_refused(tmp_path, data, message):
    path = tmp_path / "bad.safetensors"
    path.write_bytes(data)
    with pytest.raises(WeightsError, match=re.escape(f"{path}: ") + ".*" + re.escape(message)):
        Runtime(path)


def test_the_generated_headers_are_those_of_the_present_package():
    assert (ROOT / "runtime/nma/target.h").read_text() == cpp(), "run `python -m nma.export`"
    assert (ROOT / "runtime/nma/classes.h").read_text() == classes(), "run `python -m nma.export`"


def module_of(text, path: Path) -> ModuleType:
    path.write_text(textwrap.dedent(text))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_constructs_beyond_the_subset_are_refused_with_their_place(tmp_path, monkeypatch):
    text = """
    def broken(x: float) -> float:
        y = x + 1.0
        return y if x > 0 else x
    """
    path = tmp_path / "broken.py"
    module = module_of(text, path)
    monkeypatch.setitem(sys.modules, "broken", module)
    with pytest.raises(Unsupported, match=r"broken\.py:4: `y if x > 0 else x` cannot be exported"):
        print_function(parsed(module.broken))
