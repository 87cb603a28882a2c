"""The files that a mesh file names (buffers, images, material libraries), read only from beside it.

A name in a mesh file is somebody else's text: data URIs are decoded, a name that leaves the mesh's folder or points to
the network is refused, and a file that is not there is a reason to reject the object, never a texture less.
"""

import base64
import binascii
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, unquote_to_bytes

from data_gen.assets import RejectedAsset


def read_companion(folder: Path, uri: str) -> bytes:
    """Bytes of the file that `uri` names, relative to `folder` (percent escapes as in glTF), or of a data URI."""
    if uri.startswith("data:"):
        return _data_uri(uri)
    plain = folder / uri
    name = uri if _stays_inside(uri) and plain.is_file() else unquote(uri)
    if not _stays_inside(name):
        raise RejectedAsset(f"names a file outside its own folder: {uri!r}")
    try:
        return (folder / name).read_bytes()
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise RejectedAsset(f"names a file that is missing: {name!r}") from None


def _stays_inside(name: str) -> bool:
    """Whether a relative name, written with either kind of slash, cannot leave its folder."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return bool(parts) and ".." not in parts and "/" not in parts and ":" not in parts[0]


def _data_uri(uri: str) -> bytes:
    """Bytes of a data URI (RFC 2397)."""
    head, _, payload = uri.partition(",")
    try:
        return base64.b64decode(payload, validate=True) if head.endswith(";base64") else unquote_to_bytes(payload)
    except binascii.Error as error:
        raise RejectedAsset(f"holds a data URI that is not base64: {error}") from None
