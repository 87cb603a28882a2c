"""Airborne and terrestrial laser scans (.las, compressed .laz) as named columns, piece by piece, through laspy.

Coordinates come scaled and shifted as the header says, in float64; colours are 16 bit; where there are none the
intensity of the echo stands in.  Every fault is a ValueError; the caller adds the file's name.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

PIECE_POINTS = 2**19  # in memory at a time
COLUMNS = ("red", "green", "blue", "intensity")
MISSING = "needs the package {package} to be read: pip install 'spnr-jax[formats]'"


def las_pieces(path: Path) -> Iterator[dict[str, np.ndarray]]:
    """The columns x y z, the colours and the intensity of a scan, some points at a time."""
    try:
        import laspy  # an extra: only here
    except ImportError:
        raise ValueError(MISSING.format(package="laspy")) from None
    if path.suffix.lower() == ".laz" and not laspy.LazBackend.detect_available():
        raise ValueError(MISSING.format(package="lazrs"))
    try:
        with laspy.open(path) as scan:
            present = set(scan.header.point_format.dimension_names)
            for points in scan.chunk_iterator(PIECE_POINTS):
                columns = {axis: np.asarray(getattr(points, axis), np.float64) for axis in "xyz"}
                yield columns | {name: np.asarray(points[name]) for name in COLUMNS if name in present}
    except (laspy.errors.LaspyException, EOFError, RuntimeError) as error:
        raise ValueError(f"is a broken or truncated LAS file ({error})") from None
