"""Reads the size of an image from the file's header alone.

A file of a few hundred bytes may declare 10^10 pixels, so the size is checked before any pixel is read.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import BinaryIO

# The most pixels that an image may have: 16384 x 8192, as in the largest common environment maps. An image of 16384 x
# 8192 pixels takes 2 GiB as RGBA in 32-bit floats.
MOST_PIXELS = 1 << 27

_START = 1 << 16  # bytes read at the start of a file, enough for every header
_SIZE = {
    rb"\x89PNG\r\n\x1a\n.{8}(.{4})(.{4})": ">i",
    rb"BM.{16}(.{4})(.{4})": "<i",
    rb"P[F56f]\s+(?:#[^\n]*\n\s*)*(\d+)\s+(\d+)\s": "width height",
    rb"#\?.*?\n\n[-+]Y (\d+) [-+]X (\d+)\n": "height width",
}
_DATA_WINDOW = re.compile(rb"dataWindow\0box2i\0\x10\0\0\0(.{16})", re.S)
_TGA_END = b"TRUEVISION-XFILE.\0"


def header_size(path: str | Path) -> tuple[int, int] | None:
    """The width and height of an image, or None if the file has none of Mitsuba's image formats."""
    with Path(path).open("rb") as file:
        start = file.read(_START)
        for pattern, kind in _SIZE.items():
            if found := re.match(pattern, start, re.S):
                return _numbers(kind, *found.groups())
        if start.startswith(b"\x76\x2f\x31\x01"):
            return _exr(start)
        if start.startswith(b"\xff\xd8"):
            return _jpeg(file)
        return _tga(file, start)


def _numbers(kind: str, first: bytes, second: bytes) -> tuple[int, int]:
    if kind in (">i", "<i"):
        return abs(struct.unpack(kind, first)[0]), abs(struct.unpack(kind, second)[0])
    # Python refuses to convert thousands of digits, so only the first 12 digits are read, which are enough for any
    # size.
    width, height = int(first[:12]), int(second[:12])
    return (width, height) if kind == "width height" else (height, width)


def _exr(start: bytes) -> tuple[int, int] | None:
    """The size of the largest part of an EXR file, which may have several parts."""
    windows = [struct.unpack("<4i", w) for w in _DATA_WINDOW.findall(start)]
    sizes = [(right - left + 1, bottom - top + 1) for left, top, right, bottom in windows]
    return max(sizes, key=lambda size: size[0] * size[1], default=None)


def _jpeg(file: BinaryIO) -> tuple[int, int] | None:
    """The size in a JPEG file's first frame header.

    The segments before the frame header may have any length, so the segments are skipped one by one.
    """
    file.seek(2)
    while len(head := file.read(4)) == 4 and head[0] == 0xFF:
        marker, length = struct.unpack(">xBH", head)
        if marker == 0xFF:  # padding
            file.seek(-3, 1)
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            frame = file.read(5)
            height, width = struct.unpack(">xHH", frame) if len(frame) == 5 else (0, 0)
            return width, height
        file.seek(length - 2, 1)
    return None


def _tga(file: BinaryIO, start: bytes) -> tuple[int, int] | None:
    """The size of a TGA image, or None if the format's signature is missing at the end of the file."""
    end = file.seek(0, 2)
    file.seek(max(end - len(_TGA_END), 0))
    if len(start) < 18 or file.read() != _TGA_END:
        return None
    width, height = struct.unpack("<HH", start[12:16])
    return width, height
