"""A generated object opens in other tools: read here with json, trimesh and Pillow, and nothing of this project.

The reader follows nerfstudio's documentation of transforms.json: transform_matrix takes camera to world coordinates,
the camera looks along -z with y up, fl_x fl_y cx cy w h are in pixels, row 0 is the top row.
"""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.command_line import spnr_data

RESOLUTION = 48


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One lopsided object of three boxes, so that no mirrored or rotated camera fits its pictures."""
    base = tmp_path_factory.mktemp("nerfstudio")
    (base / "meshes").mkdir()
    boxes = [((1, 0.4, 0.3), (0, 0, 0)), ((0.2, 1.2, 0.2), (0.4, 0.6, 0)), ((0.2, 0.2, 0.9), (-0.4, 0.1, 0.5))]
    parts = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in boxes]
    trimesh.util.concatenate(parts).export(base / "meshes" / "thing.ply")
    size = ["--resolution", RESOLUTION, "--views", 6, "--points", 4000, "--spp", 16, "--visibility-grid", 1]
    options = ["--meshes", base / "meshes", "--test-fraction", 0, "--workers", 1]
    assert spnr_data("generate", base / "set", *options, *size) == 0
    return base / "set" / "objects" / "thing"


def read(folder):
    """Of each frame the pixels (n, 2) of the points, and the alpha (h, w), as in nerfstudio."""
    points = np.asarray(trimesh.load(folder / "points.ply").vertices)
    meta = json.loads((folder / "transforms.json").read_text())
    assert meta["camera_model"] in ("OPENCV", "PINHOLE")
    assert all(meta.get(name, 0) == 0 for name in ("k1", "k2", "p1", "p2"))
    frames = []
    for frame in meta["frames"]:
        image = np.asarray(Image.open(folder / frame["file_path"]))
        assert image.shape == (meta["h"], meta["w"], 4)
        world_to_cam = np.linalg.inv(np.array(frame["transform_matrix"]))
        x, y, z = world_to_cam[:3, :3] @ points.T + world_to_cam[:3, 3:]
        assert (z < 0).all(), "an object lies before its cameras"
        pixels = np.stack([meta["cx"] + meta["fl_x"] * x / -z, meta["cy"] - meta["fl_y"] * y / -z], axis=1)
        frames.append((pixels, image[..., 3]))
    return frames


@pytest.mark.ci  # it starts workers
def test_the_points_reproject_onto_the_object_and_cover_it(folder):
    for pixels, alpha in read(folder):
        column, row = np.floor(pixels).astype(int).T
        assert (alpha[row, column] > 0).mean() > 0.995
        drawn = np.zeros_like(alpha, bool)
        drawn[row, column] = True
        assert drawn[alpha == 255].mean() > 0.97
