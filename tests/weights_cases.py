"""Weights files (bytes) with changes, for tests of both readers."""

import json
import struct

from nma.adapter import weights_file


def stored(name):
    return weights_file(name).read_bytes()


def header_of(name):
    """Returns the parts of a shipped weights file: the header, the adapter's metadata, and the bytes of the tensors."""
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
    about = header_of("layered3-3x32")[1]
    about[group][number] |= fields
    return changed("layered3-3x32", **{group: about[group]})
