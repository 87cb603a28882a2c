"""The training step: two networks, one forward, and a state that repeats itself bit for bit."""

import dataclasses
from functools import partial
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from support.laws import close, numbers, same_bits
from support.tiny_model import MODEL, SIZE
from support.tiny_training import BATCH, CONFIG, L1_ONLY, create, near, step

from spnr_jax import methods
from spnr_jax.config import LossConfig, NetworkConfig, OptimizerConfig
from spnr_jax.kernels import losses
from spnr_jax.kernels.records import Rendering
from spnr_jax.method import inference
from spnr_jax.nn.paper_layers import Discriminator
from spnr_jax.training import optimisation


@pytest.fixture(scope="module")
def fresh_l1():
    return create(L1_ONLY)


class TestState:
    def test_equal_seeds_give_equal_bits_and_other_seeds_other_weights(self, fresh_l1):
        same_bits(create(L1_ONLY), fresh_l1)
        states = fresh_l1, create(L1_ONLY, jnp.uint32(2))
        kernels = [state.generator["encoder"]["unet"]["stem"]["kernel"] for state in states]
        assert (kernels[0] != kernels[1]).mean() > 0.99
        same_bits((fresh_l1.averaged, fresh_l1.averaged_stats), (fresh_l1.generator, fresh_l1.batch_stats))

    @pytest.mark.parametrize(
        ("weight", "share", "first"), [(1.0, 0.0, 0), (1.0, 0.25, 25), (1.0, 1.0, 100), (0.0, 0.0, 100)]
    )
    def test_the_discriminator_joins_after_its_share_of_the_steps_or_is_left_out(self, weight, share, first):
        loss = dataclasses.replace(CONFIG.loss, adversarial_weight=weight, adversarial_start=share)
        config = dataclasses.replace(CONFIG, loss=loss)
        assert optimisation.first_adversarial_step(config) == first
        state = jax.eval_shape(lambda: optimisation.create_state(config))
        assert (state.discriminator is None) == (state.discriminator_optimizer is None) == (first == config.num_steps)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaintingConfig(NetworkConfig):
    """A network whose weights are the pixels of its one picture, to see what the step asks of a network."""

    method: ClassVar[str] = "painting"
    has_discriminator: ClassVar[bool] = True


class Painting(nn.Module):
    config: PaintingConfig

    @nn.compact
    def __call__(self, cloud, camera, key=None, train=False):
        pixels = self.param("pixels", nn.initializers.constant(0.25), (camera.height, camera.width, 3))
        self.sow("losses", "size", 3 * jnp.mean(pixels**2))
        image = jnp.broadcast_to(pixels, (*camera.cam_to_world.shape[:-2], *pixels.shape))
        return Rendering(image=image, image_lr=image, depth=image[..., 0], acc=image[..., 0])


PAINTING = dataclasses.replace(
    L1_ONLY,
    model=PaintingConfig(image_resolution=SIZE),
    loss=LossConfig(l1_weight=0.0, mse_weight=2.0, adversarial_weight=0.0),
)
JUDGED = dataclasses.replace(
    PAINTING,
    loss=LossConfig(l1_weight=1.0, discriminator_width=4, r1_interval=2),
    optimizer=dataclasses.replace(CONFIG.optimizer, lr_discriminator=1e-2),
)


@pytest.fixture(autouse=True)
def _painting(monkeypatch):
    made = methods.Method(config=PaintingConfig, network=Painting, discriminator=lambda _: Discriminator(4, 2, False))
    monkeypatch.setitem(methods.METHODS, "painting", made)


def test_a_method_is_a_network_and_a_loss():
    """No statistics: the gradient of 2 mean (pixels - reference)^2 + 3 mean pixels^2, written out."""
    state = create(PAINTING)
    assert (list(state.generator), state.batch_stats) == (["pixels"], {})
    after, metrics = step(state, PAINTING)
    reference = np.float64(BATCH.image)
    expected = 2 * np.mean((0.25 - reference) ** 2) + 3 * 0.25**2
    assert float(metrics["loss"]) == pytest.approx(expected, rel=1e-5)
    assert float(metrics["size"]) == pytest.approx(3 * 0.25**2)
    gradient = (4 * np.mean(0.25 - reference, axis=(0, 1)) + 6 * 0.25) / reference[0, 0].size
    close(after.generator_optimizer[0].mu["pixels"], 0.1 * gradient, rtol=1e-4, atol=1e-7)
    assert (after.averaged["pixels"] != after.generator["pixels"]).any()


def test_the_l1_graph_contains_no_discriminator_and_before_its_time_it_is_handed_through():
    def traced(config):
        step = partial(optimisation.train_step, config=config, adversarial=False)
        return jax.make_jaxpr(step, return_shape=True)(create(config), BATCH)

    # its first kernel is the only array with a window of 4 x 4 on 7 channels: image, condition, mask
    assert "f32[4,4,7," not in str(traced(PAINTING)[0])
    graph, (shape, _) = traced(JUDGED)
    assert "f32[4,4,7," in str(graph)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(shape)]
    kept = [out for name, out in zip(names, graph.jaxpr.outvars, strict=False) if name.startswith(".discriminator")]
    assert kept
    assert set(map(id, kept)) <= set(map(id, graph.jaxpr.invars))


def test_the_step_compiles_once_and_takes_its_state_in_place():
    state, compiled = step(create(JUDGED), JUDGED)[0], optimisation.jitted_train_step._cache_size()
    for seed in range(3):
        before = state
        data = dataclasses.replace(BATCH, image=numbers(seed, 2, 1, SIZE, SIZE, 3))
        state, _ = optimisation.jitted_train_step(before, data, config=JUDGED, adversarial=True)
        donated = before.generator, before.averaged, before.discriminator
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(donated))
    assert optimisation.jitted_train_step._cache_size() == compiled


def test_a_step_is_the_discriminators_update_and_then_the_generators_written_out():
    """One forward and one pull-back give what two separate losses with their own forwards give."""
    start = create(JUDGED)
    state, metrics = step(start, JUDGED)
    generator_adam, discriminator_adam = optimisation.optimizers(JUDGED)
    real, condition, mask = BATCH.image[:, 0], BATCH.condition[:, 0], BATCH.condition_mask[:, 0]

    def judge(params, image):
        return Discriminator(4, 2, False).apply({"params": params}, image, condition, mask)

    @jax.jit
    def written_out():
        def discriminator_loss(params):
            fake = jnp.broadcast_to(start.generator["pixels"], real.shape)
            penalty = losses.r1(lambda image: judge(params, image), real)
            loss = losses.discriminator_adversarial(judge(params, real), judge(params, fake))
            return loss + JUDGED.loss.r1_interval * JUDGED.loss.r1_gamma * penalty

        gradient = jax.grad(discriminator_loss)(start.discriminator)
        update, after = discriminator_adam.update(gradient, start.discriminator_optimizer)
        discriminator = optax.apply_updates(start.discriminator, update)

        def generator_loss(params):
            image = jnp.broadcast_to(params["pixels"], real.shape)
            value = losses.l1(image, real) + losses.generator_adversarial(judge(discriminator, image))
            return value + 3 * jnp.mean(params["pixels"] ** 2)

        loss, gradient = jax.value_and_grad(generator_loss)(start.generator)
        return loss, (after[0].mu, generator_adam.update(gradient, start.generator_optimizer)[1][0].mu)

    loss, moments = written_out()
    close(metrics["loss"], loss)
    near(state.discriminator_optimizer[0].mu, moments[0])  # Adam's first step hides sizes, mu shows them
    near(state.generator_optimizer[0].mu, moments[1])
    assert state.step == 1
    for before, after in ((start.generator, state.generator), (start.discriminator, state.discriminator)):
        moved = [(a != b).any() for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)]
        assert np.mean(moved) > 0.5
    assert all(np.isfinite(value) for value in metrics.values())


@pytest.mark.ci
def test_the_loss_of_the_papers_network_is_that_of_one_forward_in_training_whose_statistics_stay(fresh_l1):
    state, metrics = step(fresh_l1, L1_ONLY)

    @jax.jit
    def forward():
        variables = {"params": fresh_l1.generator, "batch_stats": fresh_l1.batch_stats}
        key = jax.random.fold_in(fresh_l1.key, 0)
        return inference.network(MODEL).apply(
            variables, BATCH.cloud, BATCH.camera, key, train=True, mutable=["batch_stats"]
        )

    rendering, updated = forward()
    low = losses.area_downsample(BATCH.image, 8)
    close(metrics["loss"], 100 * (losses.l1(rendering.image, BATCH.image) + 0.5 * losses.l1(rendering.image_lr, low)))
    close(state.batch_stats, updated["batch_stats"])
    assert (updated["batch_stats"]["encoder"]["pointnet"]["norm_0"]["mean"] != 0).all()


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


def test_the_error_of_an_image_is_the_mean_that_the_weights_ask_for_over_all_pixels():
    image, reference = numbers(0, 2, 1, 4, 4, 3), numbers(1, 2, 1, 4, 4, 3)
    for weight, expected in (("l1_weight", np.abs(image - reference)), ("mse_weight", (image - reference) ** 2)):
        loss = dataclasses.replace(L1_ONLY.loss, **{"l1_weight": 0.0, "low_resolution_weight": 0.0, weight: 1.0})
        error_of = partial(inference.reconstruction_loss, dataclasses.replace(L1_ONLY, loss=loss), image, image)
        close(error_of(reference), expected.mean())


def test_every_step_draws_new_samples(fresh_l1):
    """The same weights and batch, one step later: another jitter, another loss."""
    (_, first), (_, later) = (step(dataclasses.replace(fresh_l1, step=jnp.int32(s)), L1_ONLY) for s in (0, 1))
    assert first["loss"] != later["loss"]


@pytest.fixture
def judge():
    return create(JUDGED).discriminator


class TestDiscriminator:
    def test_without_it_the_discriminator_sees_an_empty_image_and_mask(self, judge):
        blind = dataclasses.replace(JUDGED, loss=dataclasses.replace(JUDGED.loss, condition=False))
        image, condition, mask = (x[:, 0] for x in (BATCH.image, BATCH.condition, BATCH.condition_mask))
        empty = jnp.zeros_like(condition), jnp.zeros_like(mask)
        seen, unseen, expected = (
            jax.jit(optimisation.logits, static_argnums=0)(config, judge, image, *inputs)
            for config, inputs in ((JUDGED, (condition, mask)), (blind, (condition, mask)), (JUDGED, empty))
        )
        same_bits(unseen, expected)
        assert (seen != unseen).any()

    def test_the_penalty_comes_every_interval_and_is_scaled_by_it(self, judge):
        data, fake = BATCH, numbers(2, 2, SIZE, SIZE, 3)
        real, condition, mask = data.image[:, 0], data.condition[:, 0], data.condition_mask[:, 0]

        @jax.jit
        def parts(params, step):
            loss, metrics = optimisation.discriminator_loss(JUDGED, params, fake, data, step)
            module = optimisation.discriminator_of(JUDGED)
            penalty = losses.r1(lambda image: module.apply({"params": params}, image, condition, mask), real)
            return loss - metrics["discriminator"], 2 * 10 * penalty

        for at in range(4):
            added, penalty = parts(judge, jnp.int32(at))
            assert penalty > 0
            close(added, penalty * (at % 2 == 0), rtol=1e-3, atol=1e-5)


class TestLearningRate:
    @pytest.mark.parametrize(("warmup", "steps"), [(10, 100), (0, 50), (500, 100), (1, 1)])
    def test_rises_linearly_then_falls_by_a_cosine_to_its_last_share(self, warmup, steps):
        o = OptimizerConfig(lr_generator=2e-3, warmup_steps=warmup, final_lr_scale=0.1)
        rate = optimisation.learning_rate(dataclasses.replace(CONFIG, optimizer=o, num_steps=steps))
        warmup = min(warmup, steps)
        start = 2e-3 / max(warmup, 1)
        for at in sorted({0, warmup // 2, warmup, (warmup + steps) // 2, steps - 1}):
            if at <= warmup and warmup:
                expected = start + (2e-3 - start) * at / warmup
            else:
                share = min((at - warmup) / (max(steps, warmup + 1) - warmup), 1)
                expected = 2e-3 * (0.1 + 0.9 * 0.5 * (1 + np.cos(np.pi * share)))
            assert float(rate(at)) == pytest.approx(expected, rel=1e-5)
        assert float(rate(0)) > 0, "no step is lost"

    def test_or_by_an_exponential(self):
        """Point-NeRF's: a tenth after half of the steps."""
        o = OptimizerConfig(lr_generator=5e-4, warmup_steps=0, final_lr_scale=0.01, decay="exponential")
        rate = optimisation.learning_rate(dataclasses.replace(CONFIG, optimizer=o, num_steps=100))
        np.testing.assert_allclose([rate(at) for at in (0, 50, 100)], [5e-4, 5e-5, 5e-6], rtol=1e-4)


@pytest.mark.ci
def test_runs_under_vmap_are_the_loop_over_runs():
    states = [optimisation.jitted_create_state(JUDGED, jnp.uint32(seed)) for seed in (3, 4)]
    mapped = jax.jit(jax.vmap(partial(optimisation.train_step, config=JUDGED, adversarial=True), in_axes=(0, None)))
    after, metrics = mapped(jax.tree.map(lambda *x: jnp.stack(x), *states), BATCH)
    together = metrics, after.generator_optimizer[0].mu, after.discriminator_optimizer[0].mu
    for i, state in enumerate(states):
        alone, alone_metrics = step(state, JUDGED)  # Adam's first step hides sizes, mu shows them
        expected = alone_metrics, alone.generator_optimizer[0].mu, alone.discriminator_optimizer[0].mu
        near(jax.tree.map(lambda x, i=i: x[i], together), expected)
