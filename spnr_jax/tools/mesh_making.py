"""The surface of an object as a .glb file: the network draws it from all around, and a mesh is made from that."""

from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.kernels.records import Volume
from spnr_jax.method.model import Model
from spnr_jax.tools import fused_surface, mesh_export, splat_making
from spnr_jax.tools.mesh_export import Solid


def mesh_of_volume(model: Model, volume: Volume, placed: PlacedCloud, resolution: int = fused_surface.GRID) -> Solid:
    """The mesh of a cloud that is encoded, from a grid of so many places along each side of the box."""
    views = splat_making.drawn_views(model, volume, splat_making.fitting_cameras(model, volume))
    return mesh_export.mesh_of(fused_surface.solidity(views, volume, placed, resolution), placed)


def told(solid: Solid) -> str:
    """What a mesh is, behind the name of its file."""
    return f"{solid.faces:,} faces, {'watertight' if solid.watertight else 'not watertight'}"
