"""The refiner: what it may change of a picture, at which sizes, and how it is trained behind a network that stays."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_training
from support.laws import close, numbers, same_bits
from support.tiny_model import PLUS, camera, cloud, wobbled

from spnr_jax import presets
from spnr_jax.config import LossConfig, OptimizerConfig, RenderOptions, TrainConfig
from spnr_jax.kernels import cameras
from spnr_jax.kernels.resizing import averaged, bilinear, folded, mean_of_squares, unfolded
from spnr_jax.method import inference
from spnr_jax.method.inference import at_quality, rays_per_side
from spnr_jax.method.model import Model
from spnr_jax.nn.refiner import FOLD, LEAST, LEVELS, ODDS, Refiner
from spnr_jax.training import optimisation, weights

SQUARE = FOLD * 2 ** (LEVELS - 1)  # pixels that the coarsest level takes as one
REFINED = dataclasses.replace(PLUS, refiner_width=4)
REFINER = Refiner(width=4)
FEATURES = 8


def picture(height=24, width=16, seed=0):
    """What rays gave: an object with rims of every opacity in the middle, nothing around it."""
    acc = jnp.clip(2 * numbers(seed, 2, height, width), 0, 1)
    acc = acc.at[..., :4].set(0).at[..., -2:].set(0)[..., None]
    image = 1 - acc * numbers(seed + 1, 2, height, width, 3, low=0.0)
    told = numbers(seed + 2, 2, height, width, 3) * (acc > 0)
    return jnp.concatenate([image, told, acc * numbers(seed + 3, 2, height, width, 1), acc], axis=-1)


@pytest.fixture(scope="module")
def fresh():
    return jax.jit(REFINER.init)(jax.random.key(0), picture())


@pytest.fixture(scope="module")
def variables(fresh):
    return wobbled(fresh, 5)


class Changes(Refiner):
    @nn.compact
    def __call__(self, seen, shrink):
        return self.change(seen[..., :-1], seen[..., -1:], shrink)


@functools.partial(jax.jit, static_argnums=2)
def changes(variables, seen, shrink=1):
    return Changes(width=4).apply(variables, seen, shrink)


refine = jax.jit(REFINER.apply)


@jax.jit
def total_and_gradients(variables, seen):
    return jax.value_and_grad(lambda *x: sum(map(jnp.sum, REFINER.apply(*x))), (0, 1))(variables, seen)


class TestPicture:
    def test_a_fresh_one_changes_nothing_to_speak_of(self, fresh):
        seen = picture()
        image, acc = refine(fresh, seen)
        solid = np.asarray((seen[..., -1] == 0) | (seen[..., -1] > 0.05))  # else there is hardly a colour
        close(acc, seen[..., -1], atol=ODDS)
        close(image[solid], seen[..., :3][solid], atol=2 * ODDS)

    def test_nothing_is_drawn_where_no_point_is_near(self, variables):
        seen = picture()
        image, acc = refine(variables, seen)
        nothing = np.asarray(jnp.all(seen[..., 3:6] == 0, axis=-1))
        assert 0 < nothing.mean() < 1
        assert (np.asarray(image)[nothing] == 1).all()
        assert (np.asarray(acc)[nothing] == 0).all()
        assert np.abs(np.asarray(acc - seen[..., -1])[~nothing]).max() > 0.05, "these weights change what is there"

    def test_a_ray_that_passed_near_points_can_become_opaque(self, variables):
        seen = picture().at[..., 3:6].set(1.0)
        _, acc = refine(variables, seen)
        assert np.asarray(acc)[np.asarray(seen[..., -1]) == 0].min() > 0

    def test_what_is_seen_is_standardised_and_changed_as_odds_and_colour(self, variables):
        seen, mean, deviation = picture(), jnp.arange(8.0) / 8, 1 + jnp.arange(8.0)
        near = jnp.any(seen[..., 3:6] != 0, axis=-1, keepdims=True)
        known = {"params": variables["params"] | {"mean": mean, "deviation": deviation}}
        plain = {"params": variables["params"] | {"mean": 0 * mean, "deviation": jnp.ones(8)}}
        scaled = near * (seen - mean[None, None, None]) / deviation[None, None, None]
        expected = changes(plain, jnp.concatenate([scaled, near], axis=-1))
        odds = jnp.log(seen[..., -1] + ODDS) - jnp.log1p(ODDS - seen[..., -1])
        image, acc = refine(known, seen)
        close(acc, near[..., 0] * jax.nn.sigmoid(odds + expected[..., 3]), atol=1e-5)
        color = (seen[..., :3] - 1 + seen[..., -1:]) / jnp.maximum(seen[..., -1:], LEAST) + expected[..., :3]
        close(image, acc[..., None] * color + 1 - acc[..., None], atol=1e-4)

    def test_pixels_around_are_seen(self, variables):
        seen = picture()
        elsewhere = seen.at[:, 8:10, 8:10, -1].set(1.0)
        changed = np.asarray(refine(variables, seen)[1] != refine(variables, elsewhere)[1])
        assert changed[:, 8:10, 8:10].any()
        assert changed[:, 12:, 8:].any()

    @pytest.mark.parametrize("value", [0.0, 1e-30, 1e-8, 1.0])
    def test_extremes_of_opacity_have_finite_pictures_and_gradients(self, variables, value):
        seen = jnp.full((1, 8, 8, FEATURES), 1e4).at[..., :3].set(1 - value).at[..., -2:].set(value)
        for part in jax.tree.leaves(total_and_gradients(variables, seen)):
            assert np.isfinite(part).all()


class TestSize:
    def test_a_shift_by_a_square_shifts_the_changes(self, variables):
        seen = numbers(0, 1, 24 * SQUARE, 24 * SQUARE, FEATURES + 1)  # the middle sees no border
        moved = changes(variables, jnp.roll(seen, (SQUARE, -SQUARE), (1, 2)))[:, 96:104, 96:104]
        close(moved, changes(variables, seen)[:, 96 - SQUARE : 104 - SQUARE, 96 + SQUARE : 104 + SQUARE], atol=1e-4)
        assert np.abs(np.asarray(moved)).max() > 0.05

    def test_what_lies_beyond_the_picture_is_empty(self, variables):
        seen = numbers(0, 1, 11, 13, FEATURES + 1)
        small = changes(variables, seen, 1)
        assert small.shape == (1, 11, 13, 4)
        wide = jnp.pad(seen, ((0, 0), (0, 16 - 11), (0, 16 - 13), (0, 0)))
        close(small, changes(variables, wide, 1)[:, :11, :13], atol=1e-5)

    @pytest.mark.parametrize("shrink", [2, 3])
    def test_a_larger_picture_is_changed_as_the_smaller_one(self, variables, shrink):
        seen = numbers(0, 1, 16, 16, FEATURES + 1)
        large = jnp.repeat(jnp.repeat(seen, shrink, 1), shrink, 2)
        expected = bilinear(changes(variables, seen, 1), 16 * shrink, 16 * shrink)
        close(changes(variables, large, shrink), expected, atol=1e-5)

    def test_folding_puts_the_pixels_of_a_square_side_by_side(self):
        x = numbers(0, 2, 4, 6, 3)
        y = folded(x, 2)
        assert y.shape == (2, 2, 3, 12)
        same_bits(y[:, 1, 2], jnp.concatenate([x[:, 2, 4], x[:, 2, 5], x[:, 3, 4], x[:, 3, 5]], axis=-1))
        same_bits(unfolded(y, 2), x)
        close(mean_of_squares(x, 2), jnp.mean(y.reshape(2, 2, 3, 4, 3), axis=3))


@pytest.fixture(scope="module")
def network():
    return wobbled(jax.jit(inference.network(REFINED).init)(jax.random.key(0), cloud(), camera()), 4)


@pytest.fixture(scope="module")
def scene(network):
    return inference.jitted_encode(network, cloud(), config=REFINED)


def without(network):
    return {"params": {name: part for name, part in network["params"].items() if name != "refiner"}}


class TestRendering:
    def test_is_the_rendering_of_the_nearest_points_looked_over(self, network, scene):
        plain = inference.jitted_render(without(network), scene, camera(), config=PLUS)
        whole = inference.jitted_render(network, scene, camera(), config=REFINED)
        close(whole.image_lr, plain.image, atol=1e-4)
        assert ((np.asarray(whole.acc) > 0) == (np.asarray(plain.acc) > 0)).all()
        assert np.abs(np.asarray(whole.acc - plain.acc)).max() > 0.05
        assert np.abs(np.asarray(whole.image - plain.image)).max() > 0.05

    def test_the_object_stays_where_it_was(self, network, scene):
        """Depth is a mixture of the object's own and the far side, by the new opacity."""
        plain = inference.jitted_render(without(network), scene, camera(), config=PLUS)
        whole = inference.jitted_render(network, scene, camera(), config=REFINED)
        rays = cameras.camera_rays(camera())
        _, far, _ = cameras.intersect_box(rays.origins, rays.directions)
        there = np.asarray(plain.acc) > 0.01
        distance = far + (plain.depth - far) / jnp.where(there, plain.acc, 1)
        close((whole.acc * distance + (1 - whole.acc) * far)[there], whole.depth[there], atol=1e-3)
        nothing = np.asarray(plain.acc) == 0
        close(whole.depth[nothing], far[nothing], atol=1e-6)

    @pytest.mark.parametrize("block", [7, 300])
    def test_the_block_does_not_matter(self, network, scene, block):
        whole = inference.jitted_render(network, scene, camera(), config=REFINED)
        chunked = inference.jitted_render(network, scene, camera(), config=REFINED, options=RenderOptions(block=block))
        close(chunked, whole, atol=1e-4)

    def test_a_view_does_not_know_what_is_beside_it(self, network, scene):
        whole = inference.jitted_render(network, scene, camera(), config=REFINED)
        second = jax.tree.map(lambda x: x[1:], scene), jax.tree.map(lambda x: x[1:, :1], camera())
        alone = inference.jitted_render(network, *second, config=REFINED)
        close(alone, jax.tree.map(lambda x: x[1:, :1], whole), atol=1e-5)

    def test_a_smaller_picture_is_looked_over_at_the_size_of_the_training(self, network, scene, monkeypatch):
        """The wide picture is one compiled program's in both: what a sample sees jumps at the borders of cells, so that
        two programs, each of which rounds in its own way, show two pictures."""
        assert rays_per_side(REFINED, 4) == 2
        render = inference.render
        monkeypatch.setattr(inference, "render", inference.jitted_render)
        several = render(network, scene, camera(4), config=REFINED, options=RenderOptions(rays_per_side=2))
        same_bits(several, averaged(inference.jitted_render(network, scene, camera(8), config=REFINED), 2))

    def test_draft_does_without(self):
        assert not at_quality(REFINED, "draft", 1, REFINED.image_resolution).refine
        assert at_quality(REFINED, "balanced", 1, REFINED.image_resolution).refine
        assert at_quality(REFINED, "best", 1, REFINED.image_resolution).refine

    def test_a_smaller_picture_of_one_ray_a_pixel_is_not_looked_over(self, network):
        """There points lie closer together, in pixels, than it has learnt to see them."""
        one, refined = jax.tree.map(lambda x: x[0], cloud()), Model(config=REFINED, variables=network)
        plain = Model(config=PLUS, variables=without(network))
        for size, same in ((4, True), (8, False)):
            volumes = refined.encode(one), plain.encode(one)
            view = refined.camera(volumes[0], resolution=size)
            seen, unseen = refined.render(volumes[0], view, "trained"), plain.render(volumes[1], view, "trained")
            assert np.allclose(seen.image, unseen.image, atol=1e-4) is same

    @pytest.mark.parametrize("quality", ["draft", "balanced", "best", "trained"])
    def test_every_quality_renders(self, network, quality):
        model = Model(config=REFINED, variables=network)
        one = jax.tree.map(lambda x: x[0], cloud())
        volume = model.encode(one)
        rendering = model.render(volume, model.camera(volume, resolution=17), quality)
        assert rendering.image.shape == (17, 17, 3)
        assert np.isfinite(rendering.image).all()
        assert (np.asarray(rendering.acc) > 0).any()


CONFIG = TrainConfig(
    model=dataclasses.replace(REFINED, image_resolution=24, surface_cells=6),
    loss=LossConfig(l1_weight=1.0, mse_weight=4.0, adversarial_weight=0.0, opacity_weight=2.0),
    optimizer=OptimizerConfig(lr_generator=1e-2, warmup_steps=0),
    num_steps=30,
    batch_objects=2,
    min_points=8,
    max_points=32,
    crop=16,
)


@pytest.mark.ci
class TestTraining:
    def test_learns_with_the_network_before_it(self):
        batch, state = tiny_training.batch(), optimisation.jitted_create_state(CONFIG)
        begun, losses = jax.device_get(state.generator), []
        for _ in range(30):
            state, metrics = optimisation.jitted_train_step(state, batch, config=CONFIG, adversarial=False)
            losses.append(float(metrics["loss"]))
        assert np.mean(losses[-5:]) < np.mean(losses[:5])
        refiner = state.generator["refiner"]
        assert np.abs(refiner["out"]["kernel"]).max() > 0, "it began at zero"
        same_bits(refiner["mean"], begun["refiner"]["mean"])
        same_bits(refiner["deviation"], begun["refiner"]["deviation"])
        assert np.abs(state.generator["field"]["near"]["kernel"] - begun["field"]["near"]["kernel"]).max() > 0

    def test_begins_behind_a_network_without_it(self):
        plain = dataclasses.replace(CONFIG, model=dataclasses.replace(CONFIG.model, refiner_width=0))
        other = optimisation.averaged_variables(optimisation.jitted_create_state(plain, seed=7))
        state = optimisation.begun_with(optimisation.jitted_create_state(CONFIG), other)
        same_bits({name: state.generator[name] for name in other["params"]}, other["params"])
        same_bits(state.averaged, state.generator)
        with pytest.raises(ValueError, match="of another network: shape of params/refiner/.*, needed none"):
            optimisation.begun_with(optimisation.jitted_create_state(plain), optimisation.averaged_variables(state))


class TestConfig:
    def test_the_presets_are_those_of_the_package_s_networks(self):
        for preset, name in ((presets.near_points(), "near_points"), (presets.near_points_lite(), "near_points_lite")):
            assert preset.model == weights.read_trained(name).config.model

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"crop": 25}, "crop 25 needs .* at most its image_resolution \\(24\\)"),
            ({"crop": -1}, "crop must be a whole number, at least 0, got -1"),
            ({"pixel_stride": 2, "crop": 0}, "pixel_stride 2 needs a network whose pixels do not depend"),
        ],
    )
    def test_what_does_not_go_together_is_said(self, changes, message):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(CONFIG, **changes)

    def test_a_lattice_and_a_crop_exclude_each_other(self):
        plain = dataclasses.replace(CONFIG.model, refiner_width=0)
        with pytest.raises(ValueError, match="pixel_stride 2 and crop 16: use one"):
            dataclasses.replace(CONFIG, model=plain, pixel_stride=2)
