"""An object of a data set as a study asks for it: so many points and views, at a resolution."""

import dataclasses

import jax
import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import Dataset, ObjectData
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera
from spnr_jax.scoring import evaluation
from spnr_jax.training.gbuffers import average_squares


def test_objects(dataset: Dataset, count: int | None, points: int, *resolutions: int | None) -> tuple[str, ...]:
    """Test objects, evenly out of the split, or all; ValueError if there is none, or as they lack points or pixels."""
    names = dataset.splits["test"]
    if not names:
        raise UserError(f"{dataset.folder}: the test split is empty; generate more objects")
    first = data_sets.read_object(dataset, names[0])
    if (held := len(first.cloud.mask)) < points:
        raise UserError(
            f"{dataset.folder}: {points:,} points of an object are asked for, {held:,} are there; ask for fewer, or "
            f"generate it with --points {points}"
        )
    for resolution in resolutions:
        cut(first, resolution=resolution)
    return evaluation.pick_evenly(names, count or len(names))


def cut(
    item: ObjectData,
    points: int | None = None,
    views: int | None = None,
    resolution: int | None = None,
    normals: bool = False,
) -> ObjectData:
    """An object with its first points and views alone (None: all), in pictures that are a whole share of its own."""
    cloud = item.cloud if points is None else data_sets.first_points(item, points)
    camera, images = jax.tree.map(lambda x: x[:views], item.camera), item.images[:views]
    if resolution and resolution != camera.height:
        if camera.height % resolution:
            raise UserError(f"{resolution} pixels along a side are not a whole share of the data set's {camera.height}")
        images = np.stack([average_squares(image, camera.height // resolution) for image in images])
        camera = cameras.resize(camera, resolution, resolution)
    return dataclasses.replace(
        item,
        cloud=cloud if normals else dataclasses.replace(cloud, normals=None),
        camera=camera,
        images=images,
        conditions=item.conditions[:views],
        lights=None if item.lights is None else item.lights[:views],
    )


def each_view(item: ObjectData) -> list[Camera]:
    """The cameras of an object, one by one."""
    return [jax.tree.map(lambda x, view=view: x[view], item.camera) for view in range(len(item.images))]
