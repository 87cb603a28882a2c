"""The surface of an object as a .glb file: the network draws it from all around, and a mesh is made from that."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from spnr_jax.errors import UserError
from spnr_jax.formats import clouds, images
from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.kernels.records import Volume
from spnr_jax.method.model import Model
from spnr_jax.tools import fused_surface, mesh_export, splat_making
from spnr_jax.tools.mesh_export import Solid
from spnr_jax.training.weights import load


def mesh_of_volume(model: Model, volume: Volume, placed: PlacedCloud, resolution: int = fused_surface.GRID) -> Solid:
    """The mesh of a cloud that is encoded, from a grid of so many places along each side of the box."""
    views = splat_making.drawn_views(model, volume, splat_making.fitting_cameras(model, volume))
    return mesh_export.mesh_of(fused_surface.solidity(views, volume, placed, resolution), placed)


def told(solid: Solid) -> str:
    """What a mesh is, behind the name of its file."""
    return f"{solid.faces:,} faces, {'watertight' if solid.watertight else 'not watertight'}"


def export_mesh(
    cloud: Path,
    out: Path,
    *,
    run: Path | None,
    num_points: int,
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"],
    clean: Literal["auto", "off", "strong"],
    note: Callable[[str], None],
    report: Callable[[str], None],
) -> None:
    """Writes a cloud's mesh in the file's frame and units; `note` gets the assumptions, `report` a line about it."""
    if out.suffix.lower() != ".glb":
        raise UserError(f"{out}: a mesh is written as .glb, not {out.suffix or 'a folder'}")
    images.check_place(out)
    model = load(run)
    placed = clouds.place_cloud(cloud, num_points=num_points, up=up, clean=clean, report=note)
    solid = mesh_of_volume(model, model.encode(placed.cloud), placed)
    images.write_whole(out, solid.content)
    report(f"wrote {out} ({told(solid)}, {len(solid.content) / 1e6:.1f} MB)")
