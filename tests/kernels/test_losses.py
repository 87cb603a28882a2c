"""What training minimises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference
from support.laws import batch_law, close, gradient_law, numbers

from spnr_jax.kernels.losses import area_downsample, discriminator_adversarial, generator_adversarial, l1, mse, r1

LOGITS = 3 * numbers(0, 2, 5, 5, 1), 3 * numbers(1, 2, 5, 5, 1)


def test_l1_is_the_mean_absolute_difference():
    a, b = numbers(2, 2, 3, 3, 3), numbers(3, 2, 3, 3, 3)
    close(l1(a, b), np.abs(np.float64(a) - np.float64(b)).mean())
    gradient_law(l1, a, b)
    close(mse(a, b), ((np.float64(a) - np.float64(b)) ** 2).mean())
    gradient_law(mse, a, b)


class TestAdversarial:
    def test_losses_are_means_of_softplus(self):
        real, fake = LOGITS
        close(generator_adversarial(fake), reference.softplus(-np.float64(fake)).mean())
        close(
            discriminator_adversarial(real, fake),
            reference.softplus(-np.float64(real)).mean() + reference.softplus(np.float64(fake)).mean(),
        )
        gradient_law(generator_adversarial, fake)
        gradient_law(discriminator_adversarial, real, fake)

    @pytest.mark.parametrize("logit", [-1e4, 0.0, 1e4])
    def test_are_finite_for_a_sure_discriminator(self, logit):
        logits = jnp.full((1, 2, 2, 1), logit)
        values = (
            jax.value_and_grad(generator_adversarial)(logits),
            jax.value_and_grad(discriminator_adversarial)(logits, logits),
        )
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(values))

    def test_pull_in_opposite_directions(self):
        fake = LOGITS[1]
        assert (jax.grad(generator_adversarial)(fake) < 0).all()
        assert (jax.grad(discriminator_adversarial, 1)(LOGITS[0], fake) > 0).all()
        assert (jax.grad(discriminator_adversarial, 0)(LOGITS[0], fake) < 0).all()


class TestR1:
    weights = numbers(4, 4, 4, 3)

    def discriminator(self, image):
        return jnp.einsum("nhwc,hwc->n", image**2, self.weights)

    def test_is_half_the_mean_squared_gradient_per_image(self):
        image = numbers(5, 3, 4, 4, 3)
        gradient = 2 * np.float64(image) * np.float64(self.weights)
        close(r1(self.discriminator, image), 0.5 * (gradient**2).sum((1, 2, 3)).mean())
        gradient_law(lambda x: r1(lambda y: jnp.einsum("nhwc,nhwc->n", y**2, y), x), image)

    def test_is_zero_with_finite_gradient_at_the_zero_image(self):
        value, gradient = jax.value_and_grad(lambda x: r1(self.discriminator, x))(jnp.zeros((2, 4, 4, 3)))
        assert value == 0
        assert jnp.isfinite(gradient).all()


class TestAreaDownsample:
    @pytest.mark.parametrize(("size", "new"), [((8, 8), 4), ((10, 10), 4), ((7, 5), 3), ((3, 3), 3), ((2, 2), 3)])
    def test_is_the_mean_over_cells_for_any_ratio(self, size, new):
        image = numbers(6, *size, 3)
        close(area_downsample(image, new), reference.area_downsample(image, new))

    def test_obeys_the_batch_and_gradient_laws(self):
        image = numbers(7, 2, 3, 5, 5, 3)
        batch_law(lambda x: area_downsample(x, 3), image)
        gradient_law(lambda x: area_downsample(x, 3), image)

    def test_keeps_the_mean_and_a_constant(self):
        image = numbers(8, 50, 50, 3)
        close(area_downsample(image, 32).mean(), image.mean(), atol=1e-6)
        close(area_downsample(jnp.ones((50, 50, 3)), 32), np.ones((32, 32, 3)))
