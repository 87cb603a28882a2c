"""The mesh that an object of a data set was made from, from the data set's own records."""

import json
from pathlib import Path

import jax
import numpy as np

from data_gen.make import objects
from data_gen.render import views
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera


def mesh_of(dataset: data_sets.Dataset, item: data_sets.ObjectData, meshes: Path | None) -> Asset:
    """The normalised mesh of an object; ValueError if it cannot be made again, or is another one by now.

    `meshes` is the folder of the mesh files, where the data set was made from such.
    """
    seed = dataset.settings.get("settings", {}).get("seed")
    if seed is None:
        raise UserError(f"{dataset.folder / 'dataset.json'}: names no seed, so its meshes cannot be made again")
    positions = np.asarray(item.cloud.positions)
    return objects.original(details(dataset, item.name), seed, positions, meshes, dataset.spread)


def details(dataset: data_sets.Dataset, name: str) -> dict:
    """What object.json says of an object."""
    return json.loads((dataset.folder / "objects" / name / "object.json").read_bytes())


def cast_views(cast: views.Caster, camera: Camera) -> np.ndarray:
    """Distances (views, h, w) along the camera's rays, inf where they miss."""
    rays = jax.tree.map(np.asarray, cameras.camera_rays(camera))
    return cast(rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3)).reshape(rays.origins.shape[:3])
