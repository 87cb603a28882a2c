"""The shader: what its outputs do to light and materials, linear in the light, at every number of doublings."""

import jax
import jax.numpy as jnp
import numpy as np
from support.laws import close, numbers

from spnr_jax.kernels.imaging import srgb_to_linear
from spnr_jax.nn import shader
from spnr_jax.nn.shader import COLOR_STEP, LOGIT_MARGIN, LOGIT_STEP, NOTHING, NUM_OUTPUTS
from spnr_jax.surfels.lighting import SPECULAR

picture = jax.jit(shader.compose_picture, static_argnums=3)
NUM_MAPS, LIT = 17, slice(7, 16)  # maps of a pixel; those that are linear in the light


def maps(seed=0, size=6):
    """Materials within [0, 1] and faint light, so that no picture is clipped."""
    values = numbers(seed, 1, size, size, NUM_MAPS, low=0.1, high=0.9)
    return values.at[..., LIT].multiply(0.5).at[..., 6].multiply(0.1)


def drawn(outputs, values, ambient, doublings=0):
    """Linear light and opacity."""
    image, alpha = picture(outputs, values, ambient, doublings)
    return srgb_to_linear(image), alpha


class TestPicture:
    def test_without_outputs_it_is_the_light_that_materials_reflect(self):
        values, ambient = maps(), numbers(1, 1, 9, 3)
        linear, alpha = drawn(jnp.zeros((1, 6, 6, NUM_OUTPUTS)), values, ambient)
        color, metallic, opacity, factor, summand = np.split(np.float64(values[..., :7]), [3, 4, 5, 6], axis=-1)
        arriving, _, mirrored, reflected = np.split(np.float64(values[..., 7:]), [3, 6, 9], axis=-1)
        specular = ((SPECULAR * (1 - metallic) + color * metallic) * factor + summand) * mirrored * reflected
        close(linear, color * (1 - metallic) * arriving + specular, rtol=1e-4)
        close(alpha, ((opacity + LOGIT_MARGIN) / (1 + 2 * LOGIT_MARGIN))[..., 0], rtol=1e-4)

    def test_each_output_does_what_its_name_says(self):
        values, ambient = maps(), numbers(6, 1, 9, 3, low=0.1, high=0.3)
        values = values.at[..., :3].set(0.5).at[..., 3].set(0)

        def change(index, size=1.0):
            outputs = jnp.zeros((1, 6, 6, NUM_OUTPUTS))
            linear, alpha = drawn(outputs.at[..., index].set(size), values, ambient)
            plain, before = drawn(outputs, values, ambient)
            return np.asarray(linear - plain), np.asarray(alpha), np.asarray(before)

        close(change(0)[0][..., 0], COLOR_STEP * values[..., 7], rtol=1e-3)
        close(change(0)[0][..., 1:], np.zeros((1, 6, 6, 2)))
        _, alpha, before = change(3)
        close(np.log(alpha / (1 - alpha)), np.log(before / (1 - before)) + LOGIT_STEP, rtol=1e-3, atol=1e-3)
        close(change(4, 0.1)[0], 0.05 * values[..., 7:10], rtol=1e-3, atol=1e-6)
        close(change(5, 0.1)[0], 0.05 * values[..., 10:13], rtol=1e-3, atol=1e-6)
        specular = (SPECULAR * values[..., 5:6] + values[..., 6:7]) * values[..., 13:16]
        close(change(6)[0], specular * values[..., 16:17], rtol=1e-3, atol=1e-6)
        close(change(7)[0], specular, rtol=1e-3, atol=1e-6)
        close(change(9, 0.1)[0][..., 1], np.full((1, 6, 6), 0.05 * ambient[0, 0, 1]), rtol=1e-3)
        metal = 0.5 * (values[..., 5:6] * COLOR_STEP * (0.5 - SPECULAR)) * values[..., 13:16] * values[..., 16:17]
        close(change(19, 0.5)[0], metal - 0.25 * COLOR_STEP * values[..., 7:10], rtol=1e-3, atol=1e-6)
        rougher = (SPECULAR * values[..., 5:6] + values[..., 6:7]) * (values[..., 10:13] - values[..., 13:16])
        close(change(20, 0.5)[0], 0.5 * rougher * values[..., 16:17], rtol=1e-3, atol=1e-6)
        for k in range(1, 9):
            close(change(10 + k, 0.1)[0], np.broadcast_to(0.05 * ambient[0, k], (1, 6, 6, 3)), rtol=1e-3, atol=1e-6)

    def test_a_clear_pixel_stays_clear_whatever_the_outputs(self):
        outputs = jnp.zeros((1, 6, 6, NUM_OUTPUTS)).at[..., 3].set(1e3)
        _, alpha = picture(outputs, maps().at[..., 4].set(0), jnp.zeros((1, 9, 3)), 0)
        assert np.all(np.asarray(alpha) == 0)
        _, alpha = picture(outputs, maps().at[..., 4].set(5 * NOTHING), jnp.zeros((1, 9, 3)), 0)
        assert np.all(np.asarray(alpha) > 0.99)
