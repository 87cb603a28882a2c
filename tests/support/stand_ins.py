"""Networks without training: run folders with fresh weights, and stand-ins that show the painted balls of the tests."""

import functools
from pathlib import Path

import numpy as np

from experiments.comparison import contenders
from spnr_jax.scoring import evaluation
from spnr_jax.training import checkpoint, optimisation
from support import tiny_dataset
from support.tiny_baselines import SHRUNKEN

OFFSET = 0.125  # of the depth that a stand-in shows


@functools.cache
def fresh(preset: str) -> Path:
    """The run folder of a shrunken network that was never trained."""
    folder = tiny_dataset.folder() / "fresh" / preset
    checkpoint.write_config(folder, SHRUNKEN[preset])
    checkpoint.save(folder, optimisation.jitted_create_state(SHRUNKEN[preset]))
    return folder


class StandIn(contenders.Network):
    """A grey disc with the depth of the ball behind OFFSET, darker the more points there are."""

    def as_method(self):
        """The disc."""

        def draw(_, item):
            views, size = len(item.images), item.camera.height
            depth, acc = disc(size)
            grey = np.where(acc > 0, 1 / (1 + np.log2(len(item.cloud.mask)) / 10), 1)
            image = np.repeat(grey[..., None], 3, axis=-1).astype(np.float32)
            return evaluation.Pictures(
                image=np.tile(image, (views, 1, 1, 1)),
                acc=np.tile(acc, (views, 1, 1)),
                depth=np.tile(depth, (views, 1, 1)),
            )

        return contenders.Method(draw=draw, identity={"steps": self.steps}, has_opacity=self.has_depth)


def disc(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth and opacity of the ball of the tiny data set; every view of it looks the same."""
    focal = 0.5 * size / np.tan(np.radians(tiny_dataset.FIELD_OF_VIEW) / 2)
    x, y = np.meshgrid(*[(np.arange(size) + 0.5 - size / 2) / focal] * 2)
    along = tiny_dataset.DISTANCE / np.sqrt(1 + x**2 + y**2)
    inner = tiny_dataset.RADIUS**2 - (tiny_dataset.DISTANCE**2 - along**2)
    depth = along - np.sqrt(np.maximum(inner, 0)) + OFFSET
    return np.where(inner > 0, depth, 4).astype(np.float32), (inner > 0).astype(np.float32)


def stand_ins(*labels: str) -> dict[str, contenders.Network]:
    """Stand-ins by label; the first word of each names its method."""
    return {
        label: StandIn(
            method="npbg" if label.startswith("NPBG") else "paper",
            config=tiny_dataset.CONFIG,
            variables={},
            steps=6,
            checksum="0",
        )
        for label in labels
    }
