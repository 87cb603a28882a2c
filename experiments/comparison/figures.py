"""Pictures side by side as one picture, with names above the columns and beside the rows."""

import textwrap
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from spnr_jax.formats.images import to_uint8

INK, PAPER, GAP = (29, 35, 48), (255, 255, 255), 4
FONT_SIZE, LETTER = 12, 6.2  # pixels, the second the mean width of a letter


def grid(
    cells: Sequence[Sequence[np.ndarray]],
    columns: Sequence[str] = (),
    rows: Sequence[str] = (),
    size: int = 96,
    below: Sequence[Sequence[str]] = (),
) -> np.ndarray:
    """The rows of pictures (h, w, 3) as one (H, W, 3) uint8; every cell has `size` pixels along each side.

    `below` has a line for each picture.

    A picture of fewer pixels is shown with square ones, where they fit without rest; cells that a row lacks are white.
    """
    wide = max(map(len, cells))
    left = 110 if rows else 0
    heads = [textwrap.wrap(text, int(size / LETTER)) for text in columns]
    top = (FONT_SIZE + 3) * max(map(len, heads), default=0) + (6 if columns else 0)
    high = size + GAP + (FONT_SIZE + 2 if below else 0)
    canvas = Image.new("RGB", (left + wide * (size + GAP), top + len(cells) * high), PAPER)
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(FONT_SIZE)
    for i, lines in enumerate(heads):
        draw.text((left + i * (size + GAP), 2), "\n".join(lines), INK, font, spacing=3)
    for j, row in enumerate(cells):
        if rows:
            lines = textwrap.wrap(rows[j].replace("_", "_ "), int(left / LETTER) - 1)
            text = "\n".join(line.replace("_ ", "_") for line in lines)
            draw.text((2, top + j * high + size // 3), text, INK, font, spacing=3)
        for i, picture in enumerate(row):
            place = (left + i * (size + GAP), top + j * high)
            canvas.paste(scale(picture, size), place)
            if below:
                draw.text((place[0], place[1] + size), below[j][i], INK, font)
    return np.asarray(canvas)


def scale(picture: np.ndarray, size: int) -> Image.Image:
    """The picture with so many pixels along each side."""
    image = Image.fromarray(to_uint8(picture))
    exact = size % image.width == 0
    return image.resize((size, size), Image.Resampling.NEAREST if exact else Image.Resampling.LANCZOS)
