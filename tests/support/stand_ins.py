"""A stand-in for a network, which shows the painted balls of the tests."""

import numpy as np

from experiments.comparison import contenders
from spnr_jax.scoring import evaluation
from support import tiny_dataset

OFFSET = 0.125  # of the depth that a stand-in shows


def stand_in() -> contenders.Method:
    """A grey disc with the depth of the ball behind OFFSET."""

    def draw(_, item):
        depth, acc = disc(item.camera.height)
        image = np.repeat(np.where(acc > 0, 0.5, 1)[..., None], 3, axis=-1)
        views = {"image": image, "acc": acc, "depth": depth}
        return evaluation.Pictures(**{name: np.stack([x] * len(item.images)) for name, x in views.items()})

    return contenders.Method(draw=draw)


def disc(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth and opacity of the ball of the tiny data set; every view of it looks the same."""
    focal = 0.5 * size / np.tan(np.radians(tiny_dataset.FIELD_OF_VIEW) / 2)
    x, y = np.meshgrid(*[(np.arange(size) + 0.5 - size / 2) / focal] * 2)
    along = tiny_dataset.DISTANCE / np.sqrt(1 + x**2 + y**2)
    inner = tiny_dataset.RADIUS**2 - (tiny_dataset.DISTANCE**2 - along**2)
    depth = along - np.sqrt(np.maximum(inner, 0)) + OFFSET
    return np.where(inner > 0, depth, 4).astype(np.float32), (inner > 0).astype(np.float32)
