"""The files that a mesh file names (buffers, images, material libraries), read only from its object's own folder.

A name in a mesh file is somebody else's text: data URIs are decoded, a name that leaves the object's folder or points
to the network is refused, and a file that is not there is a reason to reject the object, never a texture less. A path
of another machine, or a name in other capitals, means the file of that name beside the mesh, if there is one. The
object's folder is the mesh's, unless its source says otherwise: a ShapeNet object keeps its images beside the folder
of its mesh (`../images`).
"""

import base64
import binascii
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, unquote_to_bytes

from spnr_jax.formats.mesh.assets import MissingFile, RejectedAsset


def read_companion(folder: Path, uri: str, root: Path | None = None) -> bytes:
    """Bytes of the file that `uri` names, relative to `folder` (percent escapes as in glTF), or of a data URI.

    `root` is the object's folder, `folder` or one above it; MissingFile for a name that leads out of it or to nothing.
    """
    if uri.startswith("data:"):
        return _data_uri(uri)
    root = folder if root is None else root
    plain = _inside(root, folder, uri)
    path = plain if plain is not None and plain.is_file() else _inside(root, folder, unquote(uri))
    if path is None or not path.is_file():
        path = _beside(folder, uri) or path
    if path is None:
        raise MissingFile(f"names a file outside its own folder: {uri!r}")
    try:
        return path.read_bytes()
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise MissingFile(f"names a file that is missing: {unquote(uri)!r}") from None


def _beside(folder: Path, uri: str) -> Path | None:
    """The file in the folder that a path of another machine means: its last name, in any letter case."""
    name = unquote(uri).replace("\\", "/").rpartition("/")[2].casefold()
    if not name or not folder.is_dir():
        return None
    return next((path for path in sorted(folder.iterdir()) if path.name.casefold() == name and path.is_file()), None)


def _inside(root: Path, folder: Path, name: str) -> Path | None:
    """The file that a name, written with either kind of slash, means from `folder`; None where it leaves `root`.

    Parent steps are resolved in the text, so that a link among the folders cannot lead them elsewhere.
    """
    parts = PurePosixPath(name.replace("\\", "/")).parts
    if not parts or "/" in parts or ":" in parts[0]:
        return None
    place = list(folder.relative_to(root).parts)
    for part in parts:
        if part != "..":
            place.append(part)
        elif place:
            place.pop()
        else:
            return None
    return root.joinpath(*place) if place else None


def _data_uri(uri: str) -> bytes:
    """Bytes of a data URI (RFC 2397)."""
    head, _, payload = uri.partition(",")
    try:
        return base64.b64decode(payload, validate=True) if head.endswith(";base64") else unquote_to_bytes(payload)
    except binascii.Error as error:
        raise RejectedAsset(f"holds a data URI that is not base64: {error}") from None
