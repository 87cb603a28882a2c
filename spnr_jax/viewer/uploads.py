"""A file that a browser sent, read as a cloud.

The browser's name for the file chooses the kind of reader and is shown, nothing else: the bytes are put into a
temporary folder under a name of ours, which is gone when the cloud is read.  Companions (textures, buffers, material
libraries) have to be inside the file, since the readers look for them in that folder alone.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path, PurePath

from spnr_jax.errors import UserError
from spnr_jax.formats import clouds
from spnr_jax.kernels.records import PointCloud

LONGEST_NAME = 60


def display_name(name: str) -> str:
    """The last part of a browser's file name, without what Markdown or a path could make of it."""
    last = PurePath(name.replace("\\", "/")).name
    return "".join(c if c.isalnum() or c in "._- " else "_" for c in last)[-LONGEST_NAME:].strip() or "file"


def read_upload(
    name: str, content: bytes, *, num_points: int, up: str, report: Callable[[str], None] = lambda line: None
) -> PointCloud:
    """The cloud in a file's bytes; ValueError, with the name as the browser gave it, for what cannot be read."""
    shown = display_name(name)
    with tempfile.TemporaryDirectory(prefix="spnr-view-") as folder:
        path = Path(folder) / f"cloud{PurePath(shown).suffix.lower()}"
        path.write_bytes(content)
        try:
            return clouds.read_cloud(path, num_points=num_points, up=up, report=report)
        except ValueError as error:
            raise UserError(str(error).replace(str(path), shown)) from None
