"""The mesh that `spnr export --mesh` writes of a cloud, read back from its file for the renderer of references.

The file is in the cloud's own frame, which in a data set is that of the cameras.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.gaussians.placing import View
from spnr_jax.kernels.records import PointCloud, Volume
from spnr_jax.tools import fused_surface, mesh_export


class ExportedMesh(NamedTuple):
    """A mesh as it is read from its file, the bytes of that, its faces, and whether each edge lies between two."""

    asset: Asset
    size: int
    faces: int
    watertight: bool


def exported(views: Sequence[View], volume: Volume, cloud: PointCloud) -> ExportedMesh:
    """The mesh of an encoded cloud by a network's pictures of it; ValueError where they show no surface."""
    placed = PlacedCloud(cloud=cloud, up="y", rotation=np.eye(3), origin=np.zeros(3))
    solid = mesh_export.mesh_of(fused_surface.solidity(views, volume, placed), placed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.glb"
        path.write_bytes(solid.content)
        return ExportedMesh(load_mesh(path), len(solid.content), solid.faces, solid.watertight)
