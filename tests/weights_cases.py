"""Weights files (bytes) with changes, for tests of both readers."""

import json
import struct
from pathlib import Path

from nma.adapter import weights_file

# A file of the first version, a 3x32 network whose target is a blend of two Principled BRDFs.
FIRST = Path(__file__).with_name("data") / "first-version.safetensors"


def stored(name):
    return weights_file(name).read_bytes()


def header_of(name):
    """Returns the parts of a weights file: the header, the adapter's metadata, and the bytes of the tensors."""
    data = stored(name)
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + size])
    return header, json.loads(header["__metadata__"]["nma"]), data[8 + size :]


def packed(header, about, data):
    header["__metadata__"]["nma"] = about if isinstance(about, str) else json.dumps(about)
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def changed(name, **fields):
    """Returns a weights file (bytes) with changed metadata."""
    header, about, data = header_of(name)
    return packed(header, about | fields, data)


def ranged(group, number, **fields):
    """Returns a weights file with a changed declaration of a parameter, in the group `parameters` or `target`."""
    about = header_of(FIRST)[1]
    about[group][number] |= fields
    return changed(FIRST, **{group: about[group]})
