"""Splats made more alike to pictures: Adam on place, shape, opacity and colour, one view a step; normals stay.

A step sees every STRIDE-th pixel of a view, in turn another share of them, and takes the mean square of colour and
opacity.  What covers what is found once for each view and share, by splats a little wider than they are.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from spnr_jax.gaussians import drawing
from spnr_jax.gaussians.placing import View
from spnr_jax.kernels.records import Camera, Gaussians

STRIDE = 2
SHARES = ((0, 0), (1, 1))  # column and row of the first pixel
LIST = 32  # splats of a pixel that are seen in a step
OPACITY_WEIGHT = 0.25  # of the opacity beside each colour
RATES = {"base": 0.02, "rest": 0.006, "opacity": 0.12, "scale": 0.03, "moved": 0.05}  # of Adam
WIDER = 1.25  # than at first the splats are, by which is found what covers what
BUCKET = 2**14  # splats
NARROWEST, WIDEST = 0.25, 3.0  # a splat's width against that at first
FARTHEST = 1.0  # that a splat moves along each axis, in its widths at first
MOST_OPACITY = 0.99

Parameters = dict[str, Array]


def parameters_of(gaussians: Gaussians) -> Parameters:
    """The unbounded numbers that are refined."""
    opacity = np.clip(np.asarray(gaussians.opacity), 0.01, MOST_OPACITY - 0.01)
    harmonics = jnp.asarray(gaussians.harmonics)
    return {
        "base": harmonics[:, :1],
        "rest": harmonics[:, 1:],
        "opacity": jnp.asarray(np.log(opacity / (MOST_OPACITY - opacity))),
        "scale": jnp.zeros((len(opacity), 2)),
        "moved": jnp.zeros((len(opacity), 3)),
    }


def gaussians_of(parameters: Parameters, first: Gaussians) -> Gaussians:
    """The splats that the parameters stand for, of those that refining began with."""
    wider = jnp.exp(jnp.clip(parameters["scale"], np.log(NARROWEST), np.log(WIDEST)))
    scale = jnp.asarray(first.scale)
    return Gaussians(
        position=jnp.asarray(first.position) + scale[:, :1] * FARTHEST * jnp.tanh(parameters["moved"] / FARTHEST),
        rotation=jnp.asarray(first.rotation),
        scale=jnp.concatenate([scale[:, :2] * wider, scale[:, 2:]], axis=-1),
        opacity=MOST_OPACITY * jax.nn.sigmoid(parameters["opacity"]),
        harmonics=jnp.concatenate([parameters["base"], parameters["rest"]], axis=1),
    )


def loss_of(
    parameters: Parameters,
    first: Gaussians,
    camera: Camera,
    found: drawing.Lists,
    wanted: Float[Array, "pixels 4"],
    dilation: float,
) -> Float[Array, ""]:
    """Mean square of colour on white, and of opacity, over the listed pixels; those with wanted NaN do not count."""
    splats = gaussians_of(parameters, first)
    foot = drawing.footprints(splats, camera, dilation)
    color = drawing.colors(splats, jnp.asarray(camera.cam_to_world)[:, 3])
    seen = drawing.blend(foot, color, splats.opacity, found, camera.width)
    image = seen[:, :3] + 1 - seen[:, 3:]
    told = jnp.isfinite(wanted[:, 3])
    goal = jnp.where(told[:, None], wanted, 0)
    error = jnp.sum((image - goal[:, :3]) ** 2, axis=-1) + OPACITY_WEIGHT * (seen[:, 3] - goal[:, 3]) ** 2
    return jnp.sum(jnp.where(told, error, 0)) / jnp.maximum(jnp.sum(told), 1)


def optimiser() -> optax.GradientTransformation:
    """Adam with a rate for each kind of parameter."""
    return optax.multi_transform({name: optax.adam(rate) for name, rate in RATES.items()}, {n: n for n in RATES})


@partial(jax.jit, donate_argnums=(0, 1))
def _step(
    parameters: Parameters,
    state: Any,
    first: Gaussians,
    camera: Camera,
    found: drawing.Lists,
    wanted: Float[Array, "pixels 4"],
    rate: Float[Array, ""],
) -> tuple[Parameters, Any, Float[Array, ""]]:
    loss, gradient = jax.value_and_grad(loss_of)(parameters, first, camera, found, wanted, drawing.DILATION / STRIDE**2)
    update, state = optimiser().update(gradient, state, parameters)
    moved = jax.tree.map(lambda x, dx: x + rate * dx, parameters, update)
    return moved, state, loss


def _padded(gaussians: Gaussians) -> Gaussians:
    """The splats with invisible ones behind them, up to a multiple of BUCKET: few sizes, few compilations."""
    extra = -len(gaussians.opacity) % BUCKET

    def longer(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.repeat(values[:1], extra, axis=0)])

    wide = jax.tree.map(lambda x: longer(np.asarray(x)), gaussians)
    wide.opacity[len(wide.opacity) - extra :] = 0
    return wide


class Refinement:
    """The refining of one object: its splats at first, its views, who covers what in them, and how far it is."""

    def __init__(self, gaussians: Gaussians, views: Sequence[View], seed: int = 0):
        self.count = len(gaussians.opacity)
        self.first = jax.tree.map(jnp.asarray, _padded(gaussians))
        self.views = views
        self.steps = 0
        self._parameters = parameters_of(self.first)
        self._state = optimiser().init(self._parameters)
        self._turns = np.random.default_rng(seed)
        self._order: list[int] = []
        self._kept: dict[tuple[int, int], tuple[Camera, drawing.Lists, np.ndarray]] = {}
        self._pixels = 0

    @property
    def gaussians(self) -> Gaussians:
        """The splats as they are now."""
        return jax.tree.map(lambda x: np.asarray(x)[: self.count], gaussians_of(self._parameters, self.first))

    def step(self, rate: float | int = 1.0) -> float:
        """The loss before a step on one view, at a share of the learning rates."""
        if not self._order:
            self._order = self._turns.permutation(len(self.views)).tolist()
        share = self.steps // len(self.views) % len(SHARES)
        seen = self._seen(self._order.pop(), share)
        self._parameters, self._state, loss = _step(self._parameters, self._state, self.first, *seen, jnp.float32(rate))
        self.steps += 1
        return float(loss)

    def _seen(self, number: int, share: int) -> tuple[Camera, drawing.Lists, np.ndarray]:
        """Camera, lists and wanted pixels of a share of a view, of the size of the largest until now."""
        if (number, share) not in self._kept:
            self._kept[number, share] = self._found(number, share)
        camera, found, wanted = self._kept[number, share]
        extra = self._pixels - len(found.pixel)
        if extra:
            found = drawing.padded(found, self._pixels, len(self.first.opacity))
            wanted = np.pad(wanted, ((0, extra), (0, 0)), constant_values=np.nan)
            self._kept[number, share] = camera, found, wanted
        return camera, found, wanted

    def _found(self, number: int, share: int) -> tuple[Camera, drawing.Lists, np.ndarray]:
        view, (column, row) = self.views[number], SHARES[share]
        camera = drawing.every(view.camera, STRIDE, column, row)
        wide = self.first.replace(scale=self.first.scale * WIDER)
        foot, _ = drawing.looked(wide, camera, jnp.float32(drawing.DILATION / STRIDE**2))
        found = drawing.lists(foot, np.asarray(self.first.opacity), camera.height, camera.width, LIST)
        picture = np.concatenate([view.image, view.opacity[..., None]], axis=-1)[row::STRIDE, column::STRIDE]
        wanted = picture.reshape(-1, 4)[found.pixel].astype(np.float32)
        found = found._replace(
            splats=np.pad(
                found.splats, ((0, LIST - len(found.splats)), (0, 0)), constant_values=len(self.first.opacity)
            )
        )
        self._pixels = max(self._pixels, drawing.size_above(len(found.pixel)))
        return camera, found, wanted
