"""Contact sheets: a grid of pictures with column headings, row labels, captions under the pictures, and a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from nma.images.io import ImageError, as_image, to_8bit, tonemap, write_png

PAPER, INK, QUIET, RULE = (250, 249, 246), (32, 33, 36), (104, 106, 110), (214, 212, 206)
TITLE_SIZE, TEXT_SIZE, CAPTION_SIZE, GAP, MARGIN = 22, 15, 13, 14, 26


class Row(NamedTuple):
    """One row of a contact sheet.

    `label`: the row's name. `images`: one image (height, width, 3) for each column. Images in linear float32 are
    tone-mapped; images of bytes are shown as they are. `captions`: a text of one or more lines for each image; the last
    images of a row may have no caption.
    """

    label: str
    images: Sequence[NDArray]
    captions: Sequence[str] = ()


def contact_sheet(
    path: str | Path,
    rows: Sequence[Row],
    columns: Sequence[str],
    *,
    title: str = "",
    table: Sequence[Sequence[str]] = (),
    note: str = "",
    exposure: float = 0.0,
    shoulder: float = 0.8,
) -> NDArray[np.uint8]:
    """Lays out a grid of pictures and writes the grid as a PNG.

    Args:
        path: the PNG file, which is written atomically.
        rows: see `Row`; all images have the same size.
        columns: the heading of each column.
        title: a line of text above the pictures.
        table: rows of text cells below the pictures. The first row is the heading; the first column is left-aligned.
        note: grey text at the bottom, for example about the tone mapping or the machine.
        exposure, shoulder: how linear images are tone-mapped (see `nma.images.io.tonemap`).

    Returns:
        The sheet as (height, width, 3) bytes.

    Raises:
        ImageError: there are no rows, a row does not have one image for each column, images have different sizes, or
            values are NaN or infinite.
    """
    pictures = [[_display(image, row.label, exposure, shoulder) for image in row.images] for row in rows]
    height, width = _common_size(pictures, columns)
    row_height = _label_height(row.label for row in rows) + height + _caption_height(rows) + GAP
    head = MARGIN + (_line(TITLE_SIZE) + GAP if title else 0)
    top = head + _label_height(columns)
    below = top + len(rows) * row_height
    note_top = below + _table_height(table) + (GAP if table else 0)
    bottom = note_top + (len(note.split("\n")) * _line(CAPTION_SIZE) if note else 0) + MARGIN
    cell = _cell_width(width, rows, columns)
    grid_width = len(columns) * (cell + GAP) - GAP
    labels = max(_width(row.label, TEXT_SIZE) for row in rows)
    words = max(_width(title, TITLE_SIZE, bold=True), _width(note, CAPTION_SIZE), _table_width(table), labels)
    content = max(grid_width, words)

    sheet = Image.new("RGB", (content + 2 * MARGIN, bottom), PAPER)
    draw = ImageDraw.Draw(sheet)
    _text(draw, (MARGIN, MARGIN), title, TITLE_SIZE, bold=True)
    for index, name in enumerate(columns):
        middle = MARGIN + index * (cell + GAP) + max(width, _width(name, TEXT_SIZE, bold=True)) / 2
        _text(draw, (middle, head), name, TEXT_SIZE, bold=True, anchor="ma")
    for index, (row, images) in enumerate(zip(rows, pictures, strict=True)):
        _draw_row(
            sheet, top + index * row_height, row, images, cell, _label_height(row.label for row in rows)
        )
    _draw_table(draw, below, table)
    _text(draw, (MARGIN, note_top), note, CAPTION_SIZE, colour=QUIET)
    pixels = np.asarray(sheet)
    write_png(path, pixels)
    return pixels


def _label_height(labels: Iterable[str]) -> int:
    """The height of a line of labels, 0 if all labels are empty."""
    return _line(TEXT_SIZE) + 4 if any(labels) else 0


def _caption_height(rows: Sequence[Row]) -> int:
    lines = max((len(text.split("\n")) for row in rows for text in row.captions), default=0)
    return lines * _line(CAPTION_SIZE) + 6 if lines else 0


def _display(image: NDArray, name: str, exposure: float, shoulder: float) -> NDArray[np.uint8]:
    array = np.asarray(image)
    if array.dtype == np.uint8 and array.ndim == 3 and array.shape[2] == 3:
        return array
    linear = as_image(array, f"contact sheet, row {name!r}")
    return to_8bit(tonemap(linear, exposure=exposure, shoulder=shoulder))


def _common_size(pictures: list[list[NDArray[np.uint8]]], columns: Sequence[str]) -> tuple[int, int]:
    if not pictures or not columns:
        raise ImageError("contact_sheet: no pictures; pass at least one row and one column")
    if any(len(row) != len(columns) for row in pictures):
        counts = ", ".join(str(len(row)) for row in pictures)
        raise ImageError(f"contact_sheet: {len(columns)} columns, but the rows hold {counts} images")
    sizes = {image.shape[:2] for row in pictures for image in row}
    if len(sizes) > 1:
        raise ImageError(
            f"contact_sheet: the images have different sizes {sorted(sizes)}; render all images at one size"
        )
    return sizes.pop()


def _cell_width(width: int, rows: Sequence[Row], columns: Sequence[str]) -> int:
    """The width of a column, wide enough for pictures, heading and captions."""
    headings = [_width(name, TEXT_SIZE, bold=True) for name in columns]
    captions = [_width(text, CAPTION_SIZE) for row in rows for text in row.captions]
    return max(width, *headings, *captions)


def _draw_row(
    sheet: Image.Image, top: float, row: Row, images: list[NDArray[np.uint8]], cell: int, label_height: int
) -> None:
    """Draws the row's label, the row's images side by side, and a caption under each image."""
    draw = ImageDraw.Draw(sheet)
    _text(draw, (MARGIN, top), row.label, TEXT_SIZE)
    top += label_height
    for index, image in enumerate(images):
        left = MARGIN + index * (cell + GAP)
        sheet.paste(Image.fromarray(image), (left, int(top)))
        if index < len(row.captions):
            _text(draw, (left, top + image.shape[0] + 4), row.captions[index], CAPTION_SIZE, colour=QUIET)


def _draw_table(draw: ImageDraw.ImageDraw, top: float, table: Sequence[Sequence[str]]) -> None:
    """Draws the cells under a bold heading: the first column is aligned left, all other columns right."""
    if not table:
        return
    left, widths = MARGIN, _column_widths(table)
    right = left + _table_width(table)
    for index, cells in enumerate(table):
        y = top + index * (_line(TEXT_SIZE) + 4)
        x = float(left)
        for column, (cell, width) in enumerate(zip(cells, widths, strict=True)):
            anchor, at = ("la", x) if column == 0 else ("ra", x + width)
            _text(draw, (at, y), cell, TEXT_SIZE, bold=index == 0, anchor=anchor)
            x += width + 2 * GAP
        draw.line([(left, y + _line(TEXT_SIZE)), (right, y + _line(TEXT_SIZE))], fill=RULE)


def _column_widths(table: Sequence[Sequence[str]]) -> list[int]:
    return [max(_width(cell, TEXT_SIZE, bold=True) for cell in column) for column in zip(*table, strict=True)]


def _table_width(table: Sequence[Sequence[str]]) -> int:
    return sum(_column_widths(table)) + 2 * GAP * (len(table[0]) - 1) if table else 0


def _table_height(table: Sequence[Sequence[str]]) -> int:
    return len(table) * (_line(TEXT_SIZE) + 4)


def _text(
    draw: ImageDraw.ImageDraw,
    at: tuple[float, float],
    text: str,
    size: int,
    *,
    bold: bool = False,
    colour: tuple[int, int, int] = INK,
    anchor: str = "la",
) -> None:
    x, y = at
    for index, line in enumerate(text.split("\n")):
        draw.text((x, y + index * _line(size)), line, font=_font(size, bold), fill=colour, anchor=anchor)


def _line(size: int) -> int:
    return round(1.35 * size)


def _width(text: str, size: int, *, bold: bool = False) -> int:
    return max(round(_font(size, bold).getlength(line)) for line in text.split("\n"))


@lru_cache(maxsize=16)
def _font(size: int, bold: bool) -> ImageFont.FreeTypeFont:
    """Loads the font DejaVu Sans. Matplotlib's files contain the font, so it need not be installed on the system."""
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)
