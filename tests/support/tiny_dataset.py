"""A data set and a run of milliseconds and seconds: coloured balls painted with NumPy, a network of few weights."""

import atexit
import dataclasses
import functools
import shutil
import tempfile
from pathlib import Path

import numpy as np

from data_gen.store import layout
from spnr_jax.config import LossConfig, OptimizerConfig, TrainConfig
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.training import trainer
from support import tiny_model

SIZE = tiny_model.SIZE
VIEWS, POINTS = 3, 40
FIELD_OF_VIEW, DISTANCE, RADIUS = 40.0, 3.0, 0.9
SPLITS = {
    "train": ("ball_000000", "ball_000001", "ball_000002", "cube_000000", "cube_000001"),
    "val": ("ball_000003",),
    "test": ("ball_000004", "cube_000002", "chair"),
}
NAMES = SPLITS["train"]
CONFIG = TrainConfig(
    preset="tiny",
    model=tiny_model.MODEL,
    loss=LossConfig(adversarial_start=0.5, discriminator_width=8, r1_interval=2),
    optimizer=OptimizerConfig(lr_generator=1e-2, warmup_steps=2, ema_decay=0.9),
    num_steps=6,
    batch_objects=2,
    views_per_object=2,
    min_points=8,
    max_points=32,
    test_points=24,
)
PLAIN = dataclasses.replace(CONFIG, loss=dataclasses.replace(CONFIG.loss, adversarial_weight=0.0))
SCHEDULE = trainer.Schedule(log_every=1, preview_every=3, checkpoint_every=2)


def write_dataset(folder: Path, splits: dict[str, tuple[str, ...]] = SPLITS, size: int = SIZE) -> Path:
    """The folder, filled as `spnr-data generate` fills it."""
    for seed, name in enumerate(name for names in splits.values() for name in names):
        layout.write_object(folder, name, ball(seed, size))
    for split, names in splits.items():
        write_whole(folder / "splits" / f"{split}.txt", "".join(f"{name}\n" for name in names).encode())
    write_whole(folder / "dataset.json", layout.json_text({"schema": layout.SCHEMA_VERSION, "seed": 0}).encode())
    return folder


def ball(seed: int, size: int = SIZE) -> layout.ObjectRecord:
    """A ball of one colour; every view shows a disc of it, and the condition image some of the disc's pixels."""
    rng = np.random.default_rng((seed, 77))
    normals = rng.normal(size=(POINTS, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    color = rng.random(3)
    points = np.zeros(POINTS, layout.POINT_TYPE)
    columns = np.concatenate([RADIUS * normals, normals, np.tile(color, (POINTS, 1)), rng.random((POINTS, 2))], axis=1)
    for name, column in zip(layout.POINT_FIELDS, columns.T, strict=True):
        points[name] = column
    poses = np.tile(np.eye(4), (VIEWS, 1, 1))
    for view in range(VIEWS):
        cosine, sine = np.cos(2.0 * view), np.sin(2.0 * view)  # turned around y, looking at the origin
        poses[view, :3] = [[cosine, 0, sine, DISTANCE * sine], [0, 1, 0, 0], [-sine, 0, cosine, DISTANCE * cosine]]
    centres = np.arange(size) + 0.5 - size / 2
    inside = centres[:, None] ** 2 + centres**2 < (0.4 * size) ** 2
    images, conditions = np.zeros((2, VIEWS, size, size, 4), np.uint8)
    images[..., :3] = np.round(255 * color)
    images[:, inside, 3] = 255
    images[:, 0, 0, 3] = 51  # a pixel that is neither full nor empty
    seen = inside & (rng.random((VIEWS, size, size)) < 0.2)
    conditions[seen] = images[seen]
    focal = 0.5 * size / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    return layout.ObjectRecord(
        points=points,
        transforms=layout.nerf_transforms(poses, size, FIELD_OF_VIEW, focal),
        images=images,
        conditions=conditions,
        details={"id": str(seed)},
    )


@functools.cache
def folder() -> Path:
    """A folder for the session, removed at its end."""
    path = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, path, ignore_errors=True)
    return path


@functools.cache
def dataset() -> data_sets.Dataset:
    """The data set on disk; copy its folder to change it."""
    return data_sets.open_dataset(write_dataset(folder() / "data"))


def one_object(name: str = NAMES[0]) -> data_sets.ObjectData:
    """An object as it is read."""
    return data_sets.read_object(dataset(), name)


@functools.cache
def run() -> Path:
    """A finished run of PLAIN with checkpoints at steps 2, 4 and 6; copy it to change it."""
    trainer.train(PLAIN, dataset(), folder() / "run", SCHEDULE)
    return folder() / "run"
