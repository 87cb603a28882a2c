"""A file that a browser sent, read as a cloud or as a map of light.

The browser's name for the file chooses the kind of reader and is shown, nothing else: the bytes are put into a
temporary folder under a name of ours, which is gone when the file is read.  Companions (textures, buffers, material
libraries) have to be inside the file, since the readers look for them in that folder alone.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePath
from typing import TypeVar

from spnr_jax.errors import UserError
from spnr_jax.formats import clouds, light_files
from spnr_jax.kernels.cleaning import Clean
from spnr_jax.kernels.records import Light, PointCloud

# A file dropped anywhere on the page goes into the file input of the upload button.
DROP = """<img alt="" style="display:none" src="data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAAC"
onload="document.body.ondragover = event => event.preventDefault();
document.body.ondrop = event => {
  if (!event.dataTransfer.files.length) return;
  event.preventDefault();
  const input = document.querySelector('input[type=file]');
  input.files = event.dataTransfer.files;
  input.dispatchEvent(new Event('change', {bubbles: true}));
};">"""
LONGEST_NAME = 60
Read = TypeVar("Read")


def display_name(name: str) -> str:
    """The last part of a browser's file name, without what Markdown or a path could make of it."""
    last = PurePath(name.replace("\\", "/")).name
    return "".join(c if c.isalnum() or c in "._- " else "_" for c in last)[-LONGEST_NAME:].strip() or "file"


def read_upload(
    name: str,
    content: bytes,
    *,
    num_points: int,
    up: str,
    clean: Clean = "off",
    report: Callable[[str], None] = lambda line: None,
) -> PointCloud:
    """The cloud in a file's bytes; ValueError, with the name as the browser gave it, for what cannot be read."""
    read = partial(clouds.read_cloud, num_points=num_points, up=up, clean=clean, report=report)
    return _read(name, content, read)


def is_map(name: str) -> bool:
    """Whether a file of that name is read as a map of light."""
    return PurePath(display_name(name)).suffix.lower() in light_files.ENDINGS


def read_uploaded_map(name: str, content: bytes) -> Light:
    """The light of a map's bytes, normalised; ValueError, with the name as the browser gave it, for what is none."""
    return _read(name, content, light_files.read_light)


def _read(name: str, content: bytes, read: Callable[[Path], Read]) -> Read:
    """What `read` makes of the bytes in a file of the name's kind."""
    shown = display_name(name)
    with tempfile.TemporaryDirectory(prefix="spnr-view-") as folder:
        path = Path(folder) / f"upload{PurePath(shown).suffix.lower()}"
        path.write_bytes(content)
        try:
            return read(path)
        except ValueError as error:
            raise UserError(str(error).replace(str(path), shown)) from None
