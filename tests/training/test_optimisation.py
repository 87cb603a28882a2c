"""The training step: two networks, one forward, and a state that repeats itself bit for bit."""

import dataclasses
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from support.laws import close, numbers, same_bits
from support.tiny_model import MODEL, SIZE
from support.tiny_training import BATCH, CONFIG, L1_ONLY, copied, create, near, run, step

from spnr_jax import methods
from spnr_jax.config import LossConfig, NetworkConfig, OptimizerConfig
from spnr_jax.kernels import losses
from spnr_jax.kernels.records import Rendering
from spnr_jax.method import inference
from spnr_jax.training import adversary, optimisation


@pytest.fixture(scope="module")
def fresh():
    return create(CONFIG)


@pytest.fixture(scope="module")
def fresh_l1():
    return create(L1_ONLY)


class TestState:
    def test_equal_seeds_give_equal_bits_and_other_seeds_other_weights(self, fresh, fresh_l1):
        same_bits(create(CONFIG), fresh)
        kernels = [state.generator["encoder"]["unet"]["stem"]["kernel"] for state in (fresh, fresh_l1)]
        assert (kernels[0] != kernels[1]).mean() > 0.99

    def test_the_average_starts_as_the_generator(self, fresh):
        same_bits(fresh.averaged, fresh.generator)
        same_bits(fresh.averaged_stats, fresh.batch_stats)

    def test_there_is_no_discriminator_at_weight_zero_or_if_its_time_never_comes(self, fresh, fresh_l1):
        assert fresh.discriminator is not None
        assert fresh_l1.discriminator is None
        assert fresh_l1.discriminator_optimizer is None
        late = dataclasses.replace(CONFIG, loss=dataclasses.replace(CONFIG.loss, adversarial_start=1.0))
        assert adversary.first_adversarial_step(late) == late.num_steps
        assert jax.eval_shape(lambda: optimisation.create_state(late)).discriminator is None

    @pytest.mark.parametrize(("share", "first"), [(0.0, 0), (0.25, 25), (1.0, 100)])
    def test_the_discriminator_joins_after_its_share_of_the_steps(self, share, first):
        loss = dataclasses.replace(CONFIG.loss, adversarial_start=share)
        assert adversary.first_adversarial_step(dataclasses.replace(CONFIG, loss=loss)) == first


@pytest.mark.ci
class TestGraph:
    @staticmethod
    def traced(state, config, adversarial):
        return str(
            jax.make_jaxpr(lambda s: optimisation.train_step(s, BATCH, config=config, adversarial=adversarial))(state)
        )

    def test_the_l1_graph_contains_no_discriminator(self, fresh, fresh_l1):
        # its first kernel is the only array with a window of 4 x 4 on 7 channels: image, condition, mask
        assert "f32[4,4,7," in self.traced(fresh, CONFIG, True)
        assert "f32[4,4,7," not in self.traced(fresh_l1, L1_ONLY, False)

    def test_before_its_time_the_discriminator_is_handed_through_untouched(self, fresh):
        def after(state):
            return optimisation.train_step(state, BATCH, config=CONFIG, adversarial=False)[0]

        traced = jax.make_jaxpr(after, return_shape=True)(fresh)
        jaxpr, shape = traced
        names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(shape)]
        kept = [out for name, out in zip(names, jaxpr.jaxpr.outvars, strict=True) if name.startswith(".discriminator")]
        assert kept
        assert set(map(id, kept)) <= set(map(id, jaxpr.jaxpr.invars))

    def test_the_step_compiles_once(self, fresh):
        state, _ = step(fresh)
        compiled = optimisation.jitted_train_step._cache_size()
        for seed in range(3):
            state, _ = step(state, data=dataclasses.replace(BATCH, image=numbers(seed, 2, 1, SIZE, SIZE, 3)))
        assert optimisation.jitted_train_step._cache_size() == compiled

    def test_the_state_is_donated(self, fresh):
        state = copied(fresh)
        optimisation.jitted_train_step(state, BATCH, config=CONFIG, adversarial=True)
        assert all(
            leaf.is_deleted() for leaf in jax.tree.leaves((state.generator, state.averaged, state.discriminator))
        )


class TestStep:
    def test_is_the_discriminators_update_and_then_the_generators_written_out(self, fresh):
        """One forward and one pull-back give what two separate losses with their own forwards give."""
        state, metrics = step(fresh)
        generator_adam, discriminator_adam = optimisation.optimizers(CONFIG)

        @jax.jit
        def written_out(start, data):
            key = jax.random.fold_in(start.key, 0)
            real, condition, mask = data.image[:, 0], data.condition[:, 0], data.condition_mask[:, 0]

            def forward(params):
                variables = {"params": params, "batch_stats": start.batch_stats}
                return inference.network(MODEL).apply(
                    variables, data.cloud, data.camera, jax.random.clone(key), train=True, mutable=["batch_stats"]
                )

            def judge(params, image):
                return adversary.discriminator_of(CONFIG).apply({"params": params}, image, condition, mask)

            def discriminator_loss(params):
                fake = jax.lax.stop_gradient(forward(start.generator)[0].image[:, 0])
                penalty = losses.r1(lambda image: judge(params, image), real)
                loss = losses.discriminator_adversarial(judge(params, real), judge(params, fake))
                return loss + CONFIG.loss.r1_interval * CONFIG.loss.r1_gamma * penalty

            gradient = jax.grad(discriminator_loss)(start.discriminator)
            update, after = discriminator_adam.update(gradient, start.discriminator_optimizer)
            discriminator = optax.apply_updates(start.discriminator, update)

            def generator_loss(params):
                rendering, _ = forward(params)
                low = losses.area_downsample(data.image, 8)
                l1 = losses.l1(rendering.image, data.image) + 0.5 * losses.l1(rendering.image_lr, low)
                return 100 * l1 + losses.generator_adversarial(judge(discriminator, rendering.image[:, 0]))

            loss, gradient = jax.value_and_grad(generator_loss)(start.generator)
            return loss, (after[0].mu, generator_adam.update(gradient, start.generator_optimizer)[1][0].mu)

        loss, moments = written_out(fresh, BATCH)
        close(metrics["loss"], loss)
        near(state.discriminator_optimizer[0].mu, moments[0])  # Adam's first step hides sizes, mu shows them
        near(state.generator_optimizer[0].mu, moments[1])

    def test_counts_itself_and_moves_both_networks(self, fresh):
        state, metrics = step(fresh)
        assert state.step == 1
        for before, after in ((fresh.generator, state.generator), (fresh.discriminator, state.discriminator)):
            moved = [(a != b).any() for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)]
            assert np.mean(moved) > 0.5
        assert all(np.isfinite(value) for value in metrics.values())
        stats = state.batch_stats["encoder"]["pointnet"]["norm_0"]
        assert (stats["mean"] != 0).all(), "running statistics are those of the forward"
        assert (stats["variance"] != 1).all()


class TestAverage:
    def test_moves_by_a_decay_that_grows_from_a_tenth_to_its_end(self, fresh_l1):
        state = fresh_l1
        for at in (0, 1, 200):
            state = dataclasses.replace(state, step=jnp.int32(at))
            after, _ = step(state, L1_ONLY)
            decay = min(0.9, (1 + at) / (10 + at))
            expected = jax.tree.map(
                lambda old, new, decay=decay: decay * old + (1 - decay) * new,
                (state.averaged, state.averaged_stats),
                (after.generator, after.batch_stats),
            )
            close((after.averaged, after.averaged_stats), expected, atol=1e-7)
            state = after
        evaluated = {"params": state.averaged, "batch_stats": state.averaged_stats}
        same_bits(optimisation.averaged_variables(state), evaluated)


class TestPixelError:
    def test_is_the_mean_of_what_the_config_asks_for(self):
        image, reference = numbers(0, 2, 1, 4, 4, 3), numbers(1, 2, 1, 4, 4, 3)
        for pixel, expected in (("l1", np.abs(image - reference)), ("mse", (image - reference) ** 2)):
            config = dataclasses.replace(L1_ONLY, loss=dataclasses.replace(L1_ONLY.loss, pixel=pixel))
            close(optimisation.pixel_error(config, image, reference), expected.mean())
            seen = jnp.arange(32).reshape(2, 1, 4, 4) % 5 == 0
            close(optimisation.pixel_error(config, image, reference, seen), expected[np.asarray(seen)].mean())
            assert optimisation.pixel_error(config, image, reference, jnp.zeros_like(seen)) == 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class OneColorConfig(NetworkConfig):
    """A network of one weight, to see what the step asks of a network."""

    method: ClassVar[str] = "one_color"


class OneColor(nn.Module):
    config: OneColorConfig

    @nn.compact
    def __call__(self, cloud, camera, key=None, train=False):
        grey = self.param("grey", nn.initializers.constant(0.25), ())
        self.sow("losses", "size", 3 * grey**2)
        image = jnp.full((*camera.cam_to_world.shape[:-2], camera.height, camera.width, 3), grey)
        return Rendering(image=image, image_lr=image, depth=image[..., 0], acc=image[..., 0])


def test_a_method_is_a_network_and_a_loss(monkeypatch):
    """One weight g, no statistics: the gradient of 2 mean (g - reference)^2 + 3 g^2, written out."""
    monkeypatch.setitem(methods.METHODS, "one_color", methods.Method(config=OneColorConfig, network=OneColor))
    config = dataclasses.replace(
        L1_ONLY,
        model=OneColorConfig(image_resolution=32),
        loss=LossConfig(l1_weight=2.0, adversarial_weight=0.0, pixel="mse"),
    )
    state = create(config)
    assert (state.generator, state.batch_stats) == ({"grey": 0.25}, {})
    after, metrics = step(state, config)
    reference = np.float64(BATCH.image)
    expected = 2 * np.mean((0.25 - reference) ** 2) + 3 * 0.25**2
    assert float(metrics["loss"]) == pytest.approx(expected, rel=1e-5)
    assert float(metrics["size"]) == pytest.approx(3 * 0.25**2)
    gradient = 4 * np.mean(0.25 - reference) + 6 * 0.25
    close(after.generator_optimizer[0].mu["grey"], 0.1 * gradient, rtol=1e-4)
    assert after.averaged["grey"] != after.generator["grey"]


class TestReproducibility:
    def test_every_step_draws_new_samples(self, fresh_l1):
        """The same weights and batch, one step later: another jitter, another loss."""
        (_, first), (_, later) = (step(dataclasses.replace(fresh_l1, step=jnp.int32(s)), L1_ONLY) for s in (0, 1))
        assert first["loss"] != later["loss"]


@pytest.mark.ci
def test_two_balls_and_their_opacity_are_learnt_from_a_lattice_of_rays():
    config = dataclasses.replace(
        L1_ONLY,
        model=dataclasses.replace(MODEL, render_resolution=SIZE, image_resolution=SIZE),
        loss=LossConfig(l1_weight=1.0, mse_weight=2.0, adversarial_weight=0.0, opacity_weight=0.5),
        optimizer=OptimizerConfig(lr_generator=5e-3, warmup_steps=4),
        pixel_stride=2,
    )
    first, metrics = run(create(config), 1, config)
    _, later = run(first, 75, config)
    squared = (metrics["loss"] - metrics["l1"] - metrics["opacity"]) / 2
    assert metrics["l1"] ** 2 < squared < metrics["l1"]
    assert later["opacity"] < 0.5 * metrics["opacity"]
    assert later["psnr"] > metrics["psnr"] + 3


@pytest.mark.ci
def test_one_batch_is_learnt_by_heart(fresh_l1):
    """Two balls on white: sixty steps leave less than a third of the loss."""
    _, start = step(fresh_l1, L1_ONLY)
    _, end = run(fresh_l1, 60, L1_ONLY)
    assert end["loss"] < start["loss"] / 3


@pytest.mark.ci
def test_adversarial_training_stays_finite_and_still_learns(fresh):
    _, start = step(fresh)
    _, end = run(fresh, 40)
    assert all(np.isfinite(value) for value in end.values())
    assert end["l1"] < start["l1"]
