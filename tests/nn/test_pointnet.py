"""PointNet: one function for every point, whatever stands around it."""

import jax
import jax.numpy as jnp
import numpy as np
from support.laws import close, numbers

from spnr_jax.kernels.imaging import srgb_to_linear
from spnr_jax.nn.paper_layers import BRIGHTNESS_AND_HUE, PointNet, spread_out

X, MASK = numbers(0, 2, 6, 5), jnp.ones((2, 6), bool).at[1, 4:].set(False)
MODULE = PointNet(widths=(8, 4), num_features=3)
VARIABLES = jax.jit(MODULE.init, static_argnums=3)(jax.random.key(0), X, MASK, True)
VARIABLES = jax.tree.map(lambda x: x + 0.1 * numbers(1, *x.shape), VARIABLES)
evaluate = jax.jit(lambda x, mask: MODULE.apply(VARIABLES, x, mask, False))
train = jax.jit(lambda x, mask: MODULE.apply(VARIABLES, x, mask, True, mutable=["batch_stats"]))


def test_in_evaluation_it_is_the_plain_perceptron():
    params, stats, y = VARIABLES["params"], VARIABLES["batch_stats"], np.float64(X)
    for i in range(2):
        norm, running = params[f"norm_{i}"], jax.tree.map(np.float64, stats[f"norm_{i}"])
        y = y @ np.float64(params[f"hidden_{i}"]["kernel"])
        y = (y - running["mean"]) / np.sqrt(running["variance"] + 1e-5)
        y = np.maximum(y * np.float64(norm["scale"]) + np.float64(norm["bias"]), 0)
    close(evaluate(X, MASK), y @ np.float64(params["out"]["kernel"]) + np.float64(params["out"]["bias"]), atol=1e-5)


def test_padding_touches_neither_real_points_nor_statistics():
    other = jnp.where(MASK[..., None], X, 1e3)
    (out, stats), (changed, changed_stats) = train(X, MASK), train(other, MASK)
    close(np.asarray(changed)[np.asarray(MASK)], np.asarray(out)[np.asarray(MASK)], atol=1e-5)
    close(changed_stats, stats)


def test_spread_materials_part_brightness_from_hue_and_lose_nothing():
    grey = jnp.tile(jnp.linspace(0, 1, 5)[:, None], (1, 3))
    close(spread_out(grey)[:, 1:], np.zeros((5, 2)), atol=1e-5)
    close(spread_out(grey)[jnp.array([0, -1]), 0], np.array([-2.0, 2.0]), atol=1e-5)
    colors = jax.random.uniform(jax.random.key(3), (40, 3))
    encoded = np.linalg.solve(np.float64(BRIGHTNESS_AND_HUE).T, np.float64(spread_out(colors)).T).T + 0.5
    close(srgb_to_linear(jnp.asarray(encoded, jnp.float32)), colors, atol=1e-5)
    close(spread_out(jnp.array([[0.0], [0.5], [1.0]])), np.array([[-1.0], [0.0], [1.0]]))
    assert jnp.isfinite(jax.grad(lambda x: spread_out(x).sum())(jnp.zeros((1, 3)))).all()
