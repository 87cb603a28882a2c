"""Surfels of a ball and a view: what the tests of the viewer look at."""

import dataclasses
import functools

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from spnr_jax.config import SurfelConfig
from spnr_jax.kernels.records import PointCloud
from spnr_jax.method import surfel_method
from spnr_jax.method.model import Model
from spnr_jax.tools import frame
from spnr_jax.tools.commands import Lighting
from spnr_jax.tools.frame import OPENCV, State, View
from support import surfel_clouds

RED, BLUE = (0.8, 0.05, 0.05), (0.05, 0.05, 0.8)


@functools.cache
def surfels() -> Model:
    """A network over surfels, whose drafts are drawn without its CNN, which is untrained."""
    config = SurfelConfig(image_resolution=24, widths=(4, 6), top=4)
    return Model(config=config, params=jax.jit(surfel_method.init, static_argnums=1)(jax.random.key(0), config))


def ball(count: int = 400) -> PointCloud:
    """A ball, red where x < 5, blue beyond."""
    positions, normals, _ = surfel_clouds.shape("sphere", count)
    color = np.where(positions[:, :1] < 0, np.float32(RED), np.float32(BLUE))
    return surfel_clouds.cloud(5 + 4 * positions, normals=normals, base_color=color)


@functools.cache
def opened() -> State:
    """The ball, opened."""
    state = frame.open_state(surfels(), ball(), "ball.xyz", Lighting())
    return dataclasses.replace(state, quality="draft")


def view(azimuth: float = 0.0, width: int = 120, height: int = 60) -> View:
    """From 4 boxes away; at azimuth 0 along -z, so that red is on the left."""
    turn = np.array(
        [[np.cos(azimuth), 0, np.sin(azimuth)], [0, 1, 0], [-np.sin(azimuth), 0, np.cos(azimuth)]]
    )  # fmt: skip
    wxyz = Rotation.from_matrix(turn @ OPENCV).as_quat(scalar_first=True)
    made = frame.read_view(wxyz, 4 * turn[:, 2], 0.7, width, height)
    assert made is not None
    np.testing.assert_allclose(made.rotation, turn, atol=1e-12)
    return made


def state(lighting: Lighting | None = None, **changes) -> State:
    """The cloud as a browser sees it."""
    made = dataclasses.replace(opened(), **{"view": view()} | changes)
    return made if lighting is None else frame.relight(made, lighting)


def canvas(moving=False, **changes) -> np.ndarray:
    """The frame of a state, int."""
    return frame.draw(surfels(), state(**changes), moving).astype(int)


def viewer(host="127.0.0.1", port=0, reached_at=None):
    """A viewer that waits for browsers; whoever opens it stops it."""
    from spnr_jax.tools.server import Viewer

    reading = {"num_points": 100, "up": "y", "clean": "auto"}
    return Viewer(surfels(), opened(), reading, host, port, reached_at)
