"""Files of points as named columns, whatever the format: {"x": (points,), "y": ..., "red": ...}, piece by piece.

    .ply              spnr_jax/formats/ply.py, also 3D Gaussian splats
    .xyz .txt .csv    spnr_jax/formats/text.py
    .pcd              spnr_jax/formats/pcd.py
    .npz .npy         spnr_jax/formats/npz.py
    .las .laz         spnr_jax/formats/las.py

A reader yields pieces of at most some ten megabytes (archives and compressed .pcd come whole), so that a file may be
larger than the memory.  Columns keep the type that the file gives them; what they mean is the affair of
spnr_jax/formats/point_columns.py.
"""

import io
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from spnr_jax.formats.las import las_pieces
from spnr_jax.formats.npz import numpy_pieces
from spnr_jax.formats.pcd import pcd_pieces
from spnr_jax.formats.ply import ply_pieces, vertex_pieces
from spnr_jax.formats.text import Columns, text_pieces

READERS = {
    ".ply": ply_pieces,
    ".pcd": pcd_pieces,
    **dict.fromkeys((".xyz", ".txt", ".csv"), text_pieces),
    **dict.fromkeys((".npz", ".npy"), numpy_pieces),
    **dict.fromkeys((".las", ".laz"), las_pieces),
}


def column_pieces(path: Path) -> Iterator[Columns]:
    """The columns of a point file, some points at a time, by its suffix (one of READERS)."""
    return READERS[path.suffix.lower()](path)


def read_columns(path: Path) -> Columns:
    """The columns of a whole point file."""
    return joined(column_pieces(path))


def parse_ply(content: bytes) -> Columns:
    """The columns of the vertices in the bytes of a PLY file."""
    return joined(vertex_pieces(io.BytesIO(content)))


def joined(pieces: Iterable[Columns]) -> Columns:
    """The columns of all pieces in one; none if there are no pieces."""
    pieces = list(pieces)
    if len(pieces) < 2:
        return pieces[0] if pieces else {}
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
