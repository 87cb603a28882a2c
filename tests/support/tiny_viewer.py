"""An untrained network, two kinds of points and a view: what the tests of the viewer look at."""

import dataclasses
import functools

import jax
import numpy as np

from spnr_jax.kernels.records import PointCloud
from spnr_jax.method import inference
from spnr_jax.method.model import Model
from spnr_jax.viewer import session
from spnr_jax.viewer.scene import Scene, open_scene
from spnr_jax.viewer.session import State
from spnr_jax.viewer.viewpoint import OPENCV, View, from_browser, to_browser
from support import surfel_clouds, tiny_model

RED, BLUE = (0.8, 0.05, 0.05), (0.05, 0.05, 0.8)


@functools.cache
def model() -> Model:
    """The network of the tests, its weights away from zero."""
    weights = jax.jit(inference.network(tiny_model.MODEL).init)(
        jax.random.key(0), tiny_model.cloud(), tiny_model.camera()
    )
    return Model(config=tiny_model.MODEL, variables=tiny_model.wobbled(weights, 4))


def cloud() -> PointCloud:
    """Red points in the half with x < 5, blue ones beyond, in units far from the box's."""
    x, y, z = np.random.default_rng(0).uniform(0, 10, (3, 200)).astype(np.float32)
    color = np.where(x[:, None] < 5, np.float32(RED), np.float32(BLUE))
    return surfel_clouds.cloud(np.stack([x, y, z], axis=1), base_color=color)


@functools.cache
def scene() -> Scene:
    """The opened cloud."""
    return open_scene(model(), cloud(), "halves.xyz")


def view(azimuth: float = 0.0, width: int = 120, height: int = 60) -> View:
    """From 4 boxes away; at azimuth 0 along -z, so that red is on the left."""
    turn = np.array(
        [[np.cos(azimuth), 0, np.sin(azimuth)], [0, 1, 0], [-np.sin(azimuth), 0, np.cos(azimuth)]]
    )  # fmt: skip
    made = from_browser(to_browser(turn), 4 * turn[:, 2], 0.7, width, height)
    assert made is not None
    np.testing.assert_allclose(made.rotation, turn, atol=1e-12)
    assert np.linalg.det(OPENCV) == 1
    return made


def state(**changes) -> State:
    """Points beside the picture, drawn as small as the network draws."""
    return dataclasses.replace(State(scene=scene(), view=view(), size=48), **changes)


def drawn(moving=False, **changes):
    return session.draw(model(), state(**changes), moving)[1]


def canvas(**changes):
    return drawn(**changes).image


def viewer(host="127.0.0.1", port=0):
    """A viewer that waits for browsers; whoever opens it stops it."""
    from spnr_jax.viewer.gui import Reading
    from spnr_jax.viewer.server import Viewer

    return Viewer(model(), state(view=None), Reading(num_points=100, up="y", clean="auto"), host, port)
