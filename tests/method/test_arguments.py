"""Arguments that do not fit are named in one line, where no types are checked: as users have it, in another process."""

import json
import subprocess
import sys
from importlib import metadata

import spnr_jax

CALLS = {
    "make_cloud(np.zeros((3, 9)))": "make_cloud: positions has the shape (3, 9), expected (points, 3)",
    "make_cloud(rows[0], rows[1, :8])": "make_cloud: base_color has the shape (8, 3), expected (9, 3)",
    "make_cloud(rows[0], metallic=rows[1])": "make_cloud: metallic has the shape (9, 3), expected (9,)",
    "neighbors(cloud.replace(positions=np.zeros((9, 2))))": "neighbors: cloud.positions has the shape (9, 2), expected",
    "neighbors(cloud.replace(positions=np.full((9, 3), np.nan)))": "neighbors: cloud.positions has NaN or infinity",
    "neighbors(cloud.replace(mask=np.ones(9)))": "neighbors: cloud.mask is of type float64, expected bool",
    "encode(None, cloud.replace(roughness=np.zeros((9, 1))), near)": "encode: cloud.roughness has the shape (9, 1), e",
    "encode(None, some(cloud), near)": "encode: cloud.mask has the shape (1, 9), expected",
    "encode(None, cloud, near[:, :8])": "encode: neighbors has the shape (9, 8), expected (9, 20); they are",
    "plan(scene, camera.replace(cam_to_world=np.eye(4)))": "plan: expected a pose (3, 4) and intrinsics (3, 3)",
    "plan(scene, camera.replace(intrinsics=np.full((3, 3), np.nan)))": "plan: the camera's pose or intrinsics hold NaN",
    "plan(cloud, camera)": "plan: expected a scene of spnr_jax.encode or Model.encode, got PointCloud",
    "render(None, scene, camera, 'studio', plan=plan(scene, camera))": "light: expected a Light, as spnr_jax.read",
    "plan(scene, camera.replace(intrinsics=-camera.intrinsics))": "plan: a focal length of camera.intrinsics is",
    "render(None, scene, camera, plan=None)": "render: expected plan=spnr_jax.plan(scene, camera), got NoneType",
    "model.render(cloud, camera)": "render: expected what Model.encode returns, got PointCloud",
    "model.render(some(scene), camera)": "render: expected one object, got a stack (1,); use jax.vmap",
    "model.render(scene, some(some(camera)))": "render: expected one camera, or one axis of them, got axes (1, 1)",
    "plan(scene, some(camera).replace(intrinsics=np.stack([camera.intrinsics] * 2)))": "plan: expected a pose (3, 4)",
    "render(model, scene, camera, plan=plan(scene, camera))": "render: expected params=model.params, or None",
    "render({'params': {}}, scene, camera, plan=plan(scene, camera))": "render: these params are of another network",
    "densify(model, cloud, near)": "densify: expected model.params, got Model",
    "render(None, scene, camera, plan=plan(scene, camera)._replace(slots=2.5))": "render: Plan(doublings=",
    "encode(None, cloud.replace(base_color=None), near)": "encode: cloud.base_color is None, expected an array (9, 3)",
    "encode(None, cloud.replace(positions=np.full((9, 3), np.nan)), near)": "encode: cloud.positions has NaN or inf",
    "spnr_jax.cameras.pinhole(camera.cam_to_world, 40.0, 8, 8)": "pinhole: field_of_view=40 is not from 0 to pi",
    "spnr_jax.cameras.pinhole(camera.cam_to_world, jax.numpy.float32(40), 8, 8)": "pinhole: field_of_view=40 is not",
    "spnr_jax.voxels.scatter_mean(rows[0], rows[1, :, 0], cloud.mask, 4)": "scatter_mean: positions, features and mask",
    "model.render(volume, camera.replace(cam_to_world=np.eye(4)))": "render: expected a pose (3, 4) and intrinsics",
    "light + 1": "unsupported operand type",
    "render(None, cloud, camera, plan=None)": "render: expected a scene of spnr_jax.encode",
    "model.encode(some(cloud))": "encode: cloud.mask has the shape (1, 9)",
    "model.render(volume, camera, light=jax.tree.map(lambda x: x[:6], light))": "light.tables has the shape (6, 32",
    "model.camera(scene, resolution=0)": "camera: resolution=0 is no number of pixels",
    "model.camera(scene, resolution=(8, 8))": "camera: resolution=(8, 8) is no number of pixels",
    "neighbors(jax.tree.map(lambda x: x[:0], cloud))": "neighbors: the cloud has no points",
    "jax.jit(neighbors)(cloud)": "neighbors: runs on the host",
    "jax.jit(lambda scene: plan(scene, camera))(scene)": "plan: runs on the host",
    "jax.jit(lambda camera: plan(scene, camera))(camera)": "plan: runs on the host",
    "jax.jit(lambda cloud: model.encode(cloud))(cloud)": "Model.encode: runs on the host",
    "jax.jit(lambda x: x + model.encode(cloud).spacing)(0)": "Model.encode: runs on the host",
    "jax.jit(lambda x: x + model.render(scene, camera).acc)(0)": "Model.render: runs on the host",
    "jax.jit(lambda camera: model.render(scene, camera))(some(camera))": "Model.render: runs on the host",
    "model.render(spnr_jax.Volume(scene, scene.centre, scene.scale), camera)": "render: expected a scene of spnr_jax",
    "encode(None, cloud, near + 9)": "encode: neighbors are int32 from -1 to 17, expected indices of 9 points",
    "densify({'densifier': {}}, cloud, near - 1)": "densify: neighbors are int32 from -2 to 7, expected indices",
    "encode(None, cloud, near + 0.0)": "encode: neighbors are float64 from -1.0 to 8.0, expected indices",
    "render(model.params['params'], scene, camera, plan=plan(scene, camera))": "render: expected params=model.params",
    "plan(scene, camera.replace(cam_to_world=look_at(*np.eye(3)[[0, 1, 1]] * [[0], [9], [1]])))": "plan: camera.cam",
    "model.encode(cloud.replace(positions=rows[0] + np.float32(1e7)))": "the positions reach 1e+07, where float32",
    "spnr_jax.light_of(np.ones((32, 64, 3), np.uint8))": "light_of: expected linear radiance in finite floats",
    "spnr_jax.light_of(jax.numpy.full((32, 64, 3), np.nan))": "light_of: expected linear radiance in finite floats",
    "light * light": "unsupported operand type",
    "spnr_jax.light_of(np.ones((64, 64, 3)))": "light_of: expected a map (height, 2 height, 3), got (64, 64, 3)",
    "spnr_jax.light_of(np.ones((0, 0, 3)))": "light_of: expected a map (height, 2 height, 3), got (0, 0, 3)",
    "jax.jit(render)(None, scene, camera, plan=plan(scene, camera))": "render: plan is traced, but gives array sizes",
    "make_cloud(rows[0], np.full((9, 3), 200))": "make_cloud: base_color holds whole numbers; expected linear floats",
    "spnr_jax.light_of(np.ones((32, 64)))": "light_of: expected a map (height, 2 height, 3), got (32, 64)",
    "model.encode(cloud.replace(base_color=np.full((9, 3), 200, np.uint8)))": "the cloud's base_color is 200 to 200",
    "model.encode(cloud.replace(roughness=-rows[2, :, 0]))": "the cloud's roughness is -",
    "spnr_jax.metrics.psnr(rows[0], rows[0, :1])": "psnr: expected two arrays of the same shape, got (9, 3) and (1, 3)",
    "spnr_jax.metrics.conditional_psnr(rows, rows, rows[0] > 0)": "conditional_psnr: expected a mask (4, 9), got",
    "spnr_jax.losses.l1(rows, rows[0])": "l1: expected two arrays of the same shape, got (4, 9, 3) and (9, 3)",
    "neighbors('chair.ply')": "neighbors: expected a PointCloud, as of read_cloud or make_cloud, got str",
    "encode(None, rows[0], near)": "encode: expected a PointCloud, as of read_cloud or make_cloud, got ndarray",
    "render(None, scene, rows[0, :3], plan=None)": "camera: expected a Camera, as of model.camera or cameras.pinhole",
    "plan(scene, [camera])": "camera: expected a Camera, as of model.camera or cameras.pinhole, got list",
    "spnr_jax.clean('chair.ply')": "clean: expected a PointCloud, as of read_cloud or make_cloud, got str",
    "model.camera(cloud)": "camera: expected what Model.encode or spnr_jax.encode returns, got PointCloud",
    "model.render(volume, [camera])": "camera: expected a Camera, as of model.camera or cameras.pinhole, got list",
    "spnr_jax.losses.mse(cloud.mask, cloud.mask)": "mse: expected floats in [0, 1], got bool and bool",
    "spnr_jax.metrics.ssim(rows, rows)": "ssim needs images of at least 11 pixels, got (4, 9)",
    "spnr_jax.sampling.importance(None, rows[0, :, 0], rows[0, :, 0], 4)": "importance: 9 edges have one weight less",
    "spnr_jax.clean(some(cloud))": "clean takes one cloud, positions (points, 3); got shape",
    "model.encode(jax.tree.map(lambda x: x[:0], cloud))": "encode: the cloud has no points",
    "model.encode(cloud.replace(mask=np.zeros(9, bool)))": "encode: the cloud has no points",
    "model.encode(cloud.replace(base_color=np.inf * rows[1]))": "encode: cloud.base_color has NaN or infinity",
    "model.render(volume, camera, 'fast')": "quality must be one of draft, balanced, best, trained, got fast",
    "render(None, scene, some(camera), plan=plan(scene, camera))": "render: camera.cam_to_world has the shape (1, 3",
    "render(None, some(scene), camera, plan=plan(scene, camera))": "render: scene.centre has the shape (1, 3), expect",
    "render(None, scene, camera, plan=plan(scene, camera)._replace(slots=0))": "render: Plan(doublings=",
}
SCRIPT = """
import json, sys
import jax, numpy as np
import spnr_jax
from spnr_jax import densify, encode, make_cloud, neighbors, plan, render
from spnr_jax.kernels.cameras import look_at

rows = np.random.default_rng(0).random((4, 9, 3)).astype(np.float32)
cloud = make_cloud(*rows[:2], *rows[2:, :, 0])
near, light, model = neighbors(cloud), spnr_jax.sun(40, 30), spnr_jax.load()
scene = jax.jit(encode)(None, cloud, near)
some = lambda tree: jax.tree.map(lambda x: x[None], tree)
camera, volume = model.camera(scene, resolution=16), scene
said = []
for call in json.loads(sys.argv[1]):
    try:
        eval(call)
        said.append("nothing")
    except (ValueError, TypeError) as error:
        said.append(str(error))
print(json.dumps(said))
"""


def test_arguments_that_do_not_fit_are_named_in_one_line():
    done = subprocess.run([sys.executable, "-c", SCRIPT, json.dumps(list(CALLS))], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for (call, expected), said in zip(CALLS.items(), json.loads(done.stdout), strict=True):
        assert said.startswith(expected), call
        assert "\n" not in said


def test_the_package_lists_its_public_names():
    assert {"load", "render", "PointCloud", "metrics"} <= set(dir(spnr_jax))
    assert all(hasattr(spnr_jax, name) for name in dir(spnr_jax))
    assert spnr_jax.__version__ == metadata.version("spnr-jax")
