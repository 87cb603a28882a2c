"""Gaussian splats drawn by Mitsuba's own renderer of them (`volprim_rf_basic`), from the .ply that the package writes.

It draws the scene a hundred times as large: it steps 1e-4 past each hit, and thin splats of a unit scene are skipped.
It gives no opacity: that is what the same splats in white show.
"""

import dataclasses
from pathlib import Path

import mitsuba
import numpy as np

from data_gen.render.views import srgb_from_linear
from spnr_jax.formats import gaussian_files
from spnr_jax.gaussians.harmonics import C0
from spnr_jax.kernels.records import Camera, Gaussians

LARGER = 100.0  # times, the scene for Mitsuba
HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # y up <-> the axes of a .ply of splats


def drawn(gaussians: Gaussians, camera: Camera, spp: int, place: Path) -> tuple[np.ndarray, np.ndarray]:
    """Picture on white (sRGB) and opacity by Mitsuba, which reads the splats from a .ply at `place`."""
    white = np.zeros_like(gaussians.harmonics)
    white[:, 0] = 0.5 / C0
    light, opacity = (
        _composited(dataclasses.replace(gaussians, harmonics=harmonics), camera, spp, place)
        for harmonics in (gaussians.harmonics, white)
    )
    return light + 1 - opacity, opacity.mean(axis=-1)


def _composited(gaussians: Gaussians, camera: Camera, spp: int, place: Path) -> np.ndarray:
    """Colours (sRGB) weighted by the opacity, (height, width, 3)."""
    larger = dataclasses.replace(gaussians, position=gaussians.position * LARGER, scale=gaussians.scale * LARGER)
    gaussian_files.write_splats(place, larger)
    pose = np.eye(4)
    pose[:3] = camera.cam_to_world
    pose[:3, 3] *= LARGER
    size, focal = camera.width, float(camera.intrinsics[0, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    sensor = {
        "type": "perspective",
        "fov": float(np.rad2deg(2 * np.arctan(0.5 * size / focal))),
        "near_clip": 0.1,
        "far_clip": 1e5,
        "to_world": mitsuba.ScalarTransform4f((HALF_TURN @ pose @ np.diag([-1.0, 1.0, -1.0, 1.0])).astype(np.float32)),
        "film": film | {"component_format": "float32"},
        "sampler": {"type": "multijitter", "sample_count": spp},
    }
    splats_of_file = {"type": "ellipsoids", "filename": str(place)}
    scene = {"type": "scene", "integrator": {"type": "volprim_rf_basic"}, "splats": splats_of_file, "sensor": sensor}
    linear = np.maximum(np.array(mitsuba.render(mitsuba.load_dict(scene), spp=spp)), 0)
    return srgb_from_linear(linear)
