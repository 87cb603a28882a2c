"""Triangles that Draco packed (KHR_draco_mesh_compression), through DracoPy, an extra.

The library holds what a packed mesh announces against the size of its data before it makes room for it.
"""

import numpy as np

from spnr_jax.formats.mesh.assets import RejectedAsset

DRACO = "KHR_draco_mesh_compression"
MISSING = "needs the package {package} to be read: pip install 'spnr-jax[meshes]'"


def decode_mesh(data: bytes, ids: dict[str, int]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns by name (v, width), of attributes by their unique ids, and vertex indices (3 f,) int64.

    Values are as they were before they were packed: whole numbers are not normalised.
    """
    try:
        import DracoPy  # an extra: only here
    except ImportError:
        raise RejectedAsset(MISSING.format(package="DracoPy")) from None
    try:
        mesh = DracoPy.decode(data)
    except (DracoPy.FileTypeException, ValueError, RuntimeError, MemoryError) as error:
        raise RejectedAsset(f"holds a Draco mesh that is broken or cut off ({error})") from None
    columns = {entry["unique_id"]: np.asarray(entry["data"]) for entry in mesh.attributes}
    faces = getattr(mesh, "faces", None)
    if faces is None:
        raise RejectedAsset("holds Draco points where triangles are needed: broken file")
    if lost := [name for name, number in ids.items() if number not in columns]:
        raise RejectedAsset(f"has no {lost[0]:.40} in its Draco mesh: broken file")
    found = {name: columns[number].reshape(len(columns[number]), -1) for name, number in ids.items()}
    return found, np.asarray(faces, np.int64).reshape(-1)
