"""What the pure functions refuse, in one line that names the function and the argument.

Values are checked only outside of programs: traced arrays have none.
"""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from spnr_jax.errors import UserError, check_kind
from spnr_jax.kernels import cameras, cloud_arrays
from spnr_jax.kernels.cloud_arrays import check_cloud
from spnr_jax.kernels.records import TABLES, AnyArray, Camera, Light, PointCloud, SurfelScene
from spnr_jax.surfels.constants import NEIGHBORS


def check_neighbors(cloud: PointCloud, neighbors: Int[AnyArray, "points 20"], where: str) -> None:
    """ValueError, which names the function and the argument, for arrays that do not fit each other."""
    check_cloud(cloud, where)
    if np.shape(neighbors) != (wanted := (len(cloud.mask), NEIGHBORS)):
        found = f"has the shape {np.shape(neighbors)}, expected {wanted}"
        raise UserError(f"{where}: neighbors {found}; they are spnr_jax.neighbors(cloud)")
    cloud_arrays.check_finite(cloud, where)
    if not isinstance(neighbors, jax.core.Tracer):
        values = np.asarray(neighbors)
        low, high = values.min(initial=-1), values.max(initial=-1)
        if not np.issubdtype(values.dtype, np.integer) or low < -1 or high >= len(cloud.mask):
            found = f"are {values.dtype} from {low} to {high}, expected indices of {len(cloud.mask)} points, or -1"
            raise UserError(f"{where}: neighbors {found}; they are spnr_jax.neighbors(cloud)")


def check_scene(scene: SurfelScene, where: str) -> None:
    """ValueError unless it is a scene."""
    check_kind(scene, SurfelScene, f"{where}: expected a scene of spnr_jax.encode or Model.encode")


def check_camera_kind(camera: Any) -> None:
    """ValueError unless it is a camera, or a batch of cameras in one record."""
    check_kind(camera, Camera, "camera: expected a Camera, as of model.camera or cameras.pinhole")


def check_light(light: Light | None) -> None:
    """ValueError unless it is one light, or None."""
    check_kind(light, Light | None, "light: expected a Light, as spnr_jax.read_light('studio') or light_of(map)")
    if light is not None and np.shape(light.tables) != TABLES:
        raise UserError(f"light.tables has the shape {np.shape(light.tables)}, not {TABLES}; use jax.vmap for more")


def check_camera(camera: Camera, where: str) -> None:
    """ValueError, which names the function, for a camera or a batch of cameras that cannot be drawn; on the host."""
    check_camera_kind(camera)
    cloud_arrays.refuse_tracers(camera, where)
    pose, intrinsics = np.shape(camera.cam_to_world), np.shape(camera.intrinsics)
    if pose[-2:] != (3, 4) or intrinsics[-2:] != (3, 3) or intrinsics[:-2] not in ((), pose[:-2]):
        expected = "a pose (3, 4) and intrinsics (3, 3) of the camera, with the same axes before them"
        raise UserError(f"{where}: expected {expected}, got {pose} and {intrinsics}")
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(camera)):
        raise UserError(f"{where}: the camera's pose or intrinsics hold NaN or infinity")
    if not np.min(np.asarray(camera.intrinsics)[..., (0, 1), (0, 1)]) > 0:
        raise UserError(f"{where}: a focal length of camera.intrinsics is 0 or negative; expected pixels")
    if not cameras.is_rotation(np.asarray(camera.cam_to_world)[..., :3]):
        raise UserError(f"{where}: camera.cam_to_world is no rotation; was `up` along the view, or the pose scaled?")


def check_view(params: dict | None, scene: SurfelScene, camera: Camera, light: Light | None) -> None:
    """ValueError in one line if there is not exactly one object, one view and one light."""
    check_light(light)
    check_camera_kind(camera)
    check_scene(scene, "render")
    for what, array, wanted in (
        ("camera.cam_to_world", camera.cam_to_world, (3, 4)),
        ("camera.intrinsics", camera.intrinsics, (3, 3)),
        ("scene.centre", scene.centre, (3,)),
        ("scene.surfels.position", scene.surfels.position, (*np.shape(scene.surfels.mask), 3)),
    ):
        if np.shape(array) != wanted:
            raise UserError(f"render: {what} has the shape {np.shape(array)}, expected {wanted}; use jax.vmap for more")
    check_kind(params, Mapping | None, "render: expected params=model.params, or None")
    if params is not None and "params" not in params:
        raise UserError(f"render: expected params=model.params, or None; got a dict of {', '.join(params)}")
    if params is not None and "top" not in params["params"]:
        raise UserError("render: these params are of another network; use Model.render, or those of spnr_jax.load()")
