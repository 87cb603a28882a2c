"""What the commands that measure speed draw: sizes that ours and the twin share, and scenes of made-up objects.

Surface points of spheres and boxes (how many voxels are occupied decides what empty space is worth), orbiting cameras,
images and crops of random numbers: no time depends on what they show.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.config import (
    EncoderConfig,
    LossConfig,
    OptimizerConfig,
    PaperConfig,
    SamplingConfig,
    SurfelConfig,
    TrainConfig,
)
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Batch, Camera, Crops, PointCloud, Volume
from spnr_jax.method.surfel_method import encode_in_box
from spnr_jax.nn import shader
from spnr_jax.presets import PRESETS
from spnr_jax.training import gbuffers

SPHERE, BOX = 0.7, 0.55  # radius and half side, in the box [-1, 1]^3
DISTANCE, FOCAL = 3.2, 2.4  # of the cameras; 1 / tan of half the field of view
FIELD_OF_VIEW = 2 * float(np.arctan(1 / FOCAL))
CLOSE = 2.2  # distance at which the sphere nearly fills the picture


def paper_training(grid: int = 64, base: int = 16, stages: int = 5, samples: int = 64, render: int = 64) -> TrainConfig:
    """A training of the paper's network as the twin has it, without R1: the preset `abo` in group norms of 8."""
    encoder = EncoderConfig(point_features=32, volume_resolution=grid, base_width=base, num_stages=stages, num_groups=8)
    model = PaperConfig(
        encoder=encoder,
        field_width=64,
        num_features=32,
        direction_frequencies=4,
        sampling=SamplingConfig(num_coarse=samples, num_fine=samples, padding=1e-5),
        render_resolution=render,
        resize_resolution=render,
        image_resolution=2 * render,
        upsampler_width=64,
    )
    loss = LossConfig(l1_weight=100.0, low_resolution_weight=0.5, r1_gamma=0.0, r1_interval=1, discriminator_width=64)
    optimizer = OptimizerConfig(lr_generator=2e-4, lr_discriminator=2e-4)
    config = TrainConfig(model=model, loss=loss, optimizer=optimizer, batch_objects=1)
    return dataclasses.replace(config, min_points=1024, max_points=1024)


PAPER = {
    "abo": paper_training(),
    "small": paper_training(grid=32, stages=4, samples=32),
    "tiny": paper_training(grid=32, base=8, stages=3, samples=16, render=32),
}


def arrays(batch: int, size: int, num_points: int, seed: int = 0) -> dict[str, np.ndarray]:
    """A batch by the names of the PyTorch twin: spheres and boxes by turns, images (batch, channels, size, size)."""
    rng = np.random.default_rng(seed)
    sphere = rng.normal(size=(batch, num_points, 3))
    sphere /= np.linalg.norm(sphere, axis=-1, keepdims=True)
    box = sphere / np.abs(sphere).max(axis=-1, keepdims=True)
    is_sphere = np.arange(batch)[:, None, None] % 2 == 0
    found = {
        "pos": np.where(is_sphere, SPHERE * sphere, BOX * box),
        "mat": rng.random((batch, num_points, 5)),
        "c2w": np.stack([pose(*rng.uniform((0, -0.36), (2 * np.pi, 0.84))) for _ in range(batch)]),
        "focal": np.full(batch, FOCAL),
        "target": rng.random((batch, 3, size, size)),
        "cond": rng.random((batch, 3, size, size)),
        "mask": rng.random((batch, 1, size, size)) < 0.5,
    }
    return {name: np.asarray(array, np.float32) for name, array in found.items()}


def as_batch(arrays: Mapping[str, np.ndarray]) -> Batch:
    """The batch of pos mat c2w focal target cond mask: one view of each object, every point real."""
    positions, materials = arrays["pos"], arrays["mat"]
    cloud = PointCloud(
        positions=positions,
        base_color=materials[..., :3],
        roughness=materials[..., 3],
        metallic=materials[..., 4],
        mask=np.ones(positions.shape[:2], bool),
    )
    images = {k: np.moveaxis(arrays[k], 1, -1)[:, None] for k in ("target", "cond", "mask")}
    size = images["target"].shape[-2]
    focal = arrays["focal"][:, None] * size / 2
    intrinsics = np.zeros((*focal.shape, 3, 3), np.float32)
    intrinsics[..., 0, 0] = intrinsics[..., 1, 1] = focal
    intrinsics[..., 0, 2] = intrinsics[..., 1, 2] = size / 2
    intrinsics[..., 2, 2] = 1
    camera = Camera(cam_to_world=arrays["c2w"][:, None], intrinsics=intrinsics, height=size, width=size)
    return Batch(
        cloud=cloud,
        camera=camera,
        image=images["target"],
        alpha=np.ones_like(images["mask"][..., 0]),  # the twin has no loss of opacity
        condition=images["cond"],
        condition_mask=images["mask"][..., 0] > 0.5,
    )


def pose(azimuth: float, elevation: float) -> np.ndarray:
    """Camera-to-world matrix (3, 4) that looks at the origin, y up, angles in radians."""
    backward = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    return np.stack([right, np.cross(backward, right), backward, DISTANCE * backward], axis=-1)


def sphere(count: int, seed: int = 0) -> PointCloud:
    """So many points of a sphere with random materials and its normals."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return PointCloud(
        positions=SPHERE * normals,
        base_color=rng.random((count, 3), np.float32),
        roughness=rng.random(count, np.float32),
        metallic=rng.random(count, np.float32),
        normals=normals,
        mask=np.ones(count, bool),
    )


def orbiting(size: int, azimuth: float = 0.5) -> Camera:
    """A camera around the origin whose pictures have this size."""
    pose = cameras.orbit(azimuth, elevation=0.35, distance=CLOSE, centre=jnp.zeros(3))
    return cameras.pinhole(pose, FIELD_OF_VIEW, size, size)


def random_crops(config: TrainConfig, doublings: int, seed: int = 0) -> Crops:
    """A batch as `gbuffers.make_batch` makes it, of random numbers."""
    rng = np.random.default_rng(seed)
    count = config.batch_objects
    size, margin = (-(-config.crop * n[doublings] // gbuffers.SIZES[0]) for n in (gbuffers.SIZES, gbuffers.MARGINS))
    inner = size - 2 * margin
    large = inner << doublings
    crops = Crops(
        seen=rng.random((count, size, size, shader.NUM_FEATURES), np.float32),
        maps=rng.random((count, inner, inner, shader.NUM_MAPS), np.float32),
        ambient=rng.random((count, 9, 3), np.float32),
        target=rng.integers(0, 256, (count, large, large, 4), np.uint8),
        doublings=doublings,
        margin=margin,
    )
    return jax.device_put(crops)


def surfel_training(quick: bool) -> TrainConfig:
    """The preset `surfels`, for a check with a small network."""
    config = PRESETS["surfels"]()
    small = SurfelConfig(widths=(4, 6), top=4)
    return dataclasses.replace(config, model=small, crop=16, batch_objects=2) if quick else config


def surfel_volume(points: int) -> Volume:
    """The sphere, encoded for the network over surfels."""
    scene = encode_in_box(sphere(points))
    return Volume(scene=scene, centre=scene.centre, scale=scene.scale)
