"""The mesh that an object of a data set was made from, made again from its record (object.json).

A procedural object follows from the data set's seed and the object's id; a mesh file has to be there again, under the
folder that the data set was made from (`root`).  The points that the data set holds are drawn from the mesh once more
and compared: a file that changed, or a generator that did, is refused, since its depths would be of something else.
"""

from pathlib import Path

import numpy as np

from data_gen.make.objects import make_asset
from data_gen.plan.tasks import Task
from spnr_jax.errors import UserError
from spnr_jax.formats.mesh.assets import Asset, RejectedAsset
from spnr_jax.formats.mesh.surface_points import Spread, sample_surface

MOVED = 1e-4  # of the object's half diagonal; the same mesh gives the same points but for a last bit


def original(
    details: dict, seed: int, stored: np.ndarray, root: Path | None = None, spread: Spread = "random"
) -> Asset:
    """The normalised object of an object.json and the seed of its data set, checked against its points (n, 3).

    ValueError, with what to do, where it cannot be had.
    """
    task = task_of(details, root)
    if task.path and not task.path.is_file():
        raise UserError(f"{task.path}: the mesh of object {task.object_id} is not there; give its folder with --meshes")
    try:
        asset = make_asset(task, seed)[0]
        again = sample_surface(asset, len(stored), details["seeds"]["points"], spread).positions
    except RejectedAsset as error:
        raise UserError(f"{task.shown_path or task.object_id}: cannot be made again ({error})") from None
    moved = float(np.abs(again - stored).max(initial=0))
    if not moved < MOVED:
        raise UserError(
            f"object {task.object_id}: its points do not lie on the mesh that is made now (off by up to {moved:.3g}): "
            "the mesh file or the generator has changed; generate the data set again"
        )
    return asset


def task_of(details: dict, root: Path | None) -> Task:
    """What made the object: a category, or a mesh file under the root."""
    name, source = details["id"], details["source"]
    variant = details.get("variant", 0)  # data sets from before there were colour variants do not say
    made = {
        "object_id": name,
        "variant_of": details["product"] if variant else "",
        "colour_variant": variant,
        "reshaped": "reshaping" in details,
    }
    if "file" not in source:
        return Task(category=details["category"], **made)
    if root is None:
        raise UserError(f"object {name} was made from {source['file']}: give the folder of the meshes with --meshes")
    return Task(path=root / source["file"], folder=root, shown_path=source["file"], **made)
