"""The mesh that `spnr render --mesh` writes of a cloud, read back from its file for the renderer of references.

The file is in the cloud's own frame, which in a data set is that of the cameras.
"""

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.kernels.records import PointCloud
from spnr_jax.method.model import Model
from spnr_jax.tools import density_grid, mesh_export
from spnr_jax.tools.pictures import mesh_level

RESOLUTION = 96  # places along each side of the grid, as the command has it


class ExportedMesh(NamedTuple):
    """A mesh as it is read from its file, the bytes of that, its faces, and whether each edge lies between two."""

    asset: Asset
    size: int
    faces: int
    watertight: bool


def exported(model: Model, cloud: PointCloud, resolution: int = RESOLUTION) -> ExportedMesh:
    """The mesh of a cloud by a network that has a density; ValueError where that shows no surface."""
    placed = PlacedCloud(cloud=cloud, up="y", rotation=np.eye(3), origin=np.zeros(3))
    grid = density_grid.sample_density(model, model.encode(cloud), placed, resolution)
    solid = mesh_export.mesh_of(grid, placed, mesh_level(grid.voxel))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.glb"
        path.write_bytes(solid.content)
        return ExportedMesh(load_mesh(path), len(solid.content), solid.faces, solid.watertight)
