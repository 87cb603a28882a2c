"""The generator as a whole, shrunken: what must not change its pictures, and what must."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from laws import batch_law, close, gradient_law, numbers, same_bits

from spnr_jax import training
from spnr_jax.cameras import look_at, pinhole
from spnr_jax.config import ModelConfig, SamplingConfig
from spnr_jax.renderer import Renderer, union_weights
from spnr_jax.types import PointCloud

CONFIG = ModelConfig(
    point_widths=(8,),
    point_features=4,
    volume_resolution=8,
    base_width=4,
    num_stages=1,
    num_groups=2,
    field_width=8,
    num_features=5,
    direction_frequencies=1,
    sampling=SamplingConfig(num_coarse=4, num_fine=4),
    render_resolution=8,
    resize_resolution=8,
    image_resolution=8,
    upsampler_width=4,
)
NUM_POINTS = 40


def cloud():
    return PointCloud(
        positions=0.7 * numbers(0, 2, NUM_POINTS, 3),
        base_color=numbers(1, 2, NUM_POINTS, 3, low=0.0),
        roughness=numbers(2, 2, NUM_POINTS, low=0.0),
        metallic=numbers(3, 2, NUM_POINTS, low=0.0),
        mask=jnp.ones((2, NUM_POINTS), bool),
    )


def camera(size=8, target=0.0):
    eyes = jnp.asarray(np.float32([[[0, 1, 3], [3, 1, 0.5]], [[-2, 2, -2], [0.5, -1, 3]]]))
    pose = look_at(eyes, jnp.full(eyes.shape, target), jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0]), eyes.shape))
    return pinhole(pose, 0.9, size, size)


def wobbled(variables, seed):
    """Weights away from the zeros and ones that they start at."""
    return jax.tree.map(lambda x: x + 0.2 * numbers(seed, *x.shape), variables)


@pytest.fixture(scope="module")
def variables():
    return wobbled(jax.jit(Renderer(CONFIG).init)(jax.random.key(0), cloud(), camera()), 4)


def encode(variables, cloud, config=CONFIG):
    return training.jitted_encode(variables, cloud, config=config)


def render(variables, volume, camera, config=CONFIG, **options):
    return training.jitted_render(variables, volume, camera, config=config, **options)


@jax.jit
def jittered(variables, cloud, camera, key):
    return Renderer(CONFIG).apply(variables, cloud, camera, key, train=True, mutable=["batch_stats"])


class TestCloud:
    def test_the_order_of_the_points_does_not_change_the_volume(self, variables):
        order = np.random.default_rng(5).permutation(NUM_POINTS)
        shuffled = jax.tree.map(lambda x: x[:, order], cloud())
        close(encode(variables, shuffled), encode(variables, cloud()), rtol=1e-4, atol=1e-5)

    @pytest.mark.parametrize("fill", [0.0, np.nan])
    def test_padding_does_not_change_image_or_statistics_whatever_it_holds(self, variables, fill):
        plain, key = cloud(), jax.random.key(1)

        def pad(x):
            return jnp.concatenate([x, jnp.full((2, 5, *x.shape[2:]), fill, x.dtype)], axis=1)

        padded = jax.tree.map(pad, dataclasses.replace(plain, mask=jnp.zeros((2, NUM_POINTS))))
        padded = dataclasses.replace(padded, mask=jnp.concatenate([plain.mask, jnp.zeros((2, 5), bool)], axis=1))
        expected = jittered(variables, plain, camera(), jax.random.clone(key))
        close(jittered(variables, padded, camera(), key), expected, rtol=1e-4, atol=1e-5)

    def test_in_evaluation_an_object_does_not_see_the_others(self, variables):
        both = render(variables, encode(variables, cloud()), camera())
        alone = jax.tree.map(lambda x: x[1:], (cloud(), camera()))
        close(
            render(variables, encode(variables, alone[0]), alone[1]),
            jax.tree.map(lambda x: x[1:], both),
            rtol=1e-4,
            atol=1e-5,
        )

    def test_no_point_gives_a_finite_volume(self, variables):
        empty = dataclasses.replace(cloud(), mask=jnp.zeros((2, NUM_POINTS), bool))
        assert jnp.isfinite(encode(variables, empty)).all()

    @pytest.mark.parametrize("materials", [(), ("roughness",), ("base_color", "metallic")], ids=str)
    def test_materials_that_the_config_leaves_out_are_not_read(self, materials):
        config = dataclasses.replace(CONFIG, materials=materials)
        module, unread = Renderer(config), {"base_color", "roughness", "metallic"} - set(materials)
        spoilt = dataclasses.replace(
            cloud(), **{name: jnp.full_like(getattr(cloud(), name), jnp.nan) for name in unread}
        )
        inputs = module.apply({}, spoilt, method="point_inputs")
        assert inputs.shape[-1] == 6 + config.num_material_channels
        assert jnp.isfinite(inputs).all()
        names = iter(range(6, inputs.shape[-1]))
        for name in materials:
            given = np.asarray(getattr(cloud(), name)).reshape(2, NUM_POINTS, -1)
            close(np.asarray(inputs)[..., [next(names) for _ in range(given.shape[-1])]], given, rtol=0)


class TestViews:
    def test_a_view_does_not_depend_on_the_other_views(self, variables):
        volume, views = encode(variables, cloud()), camera()
        both = render(variables, volume, views)
        second = jax.tree.map(lambda x: x[:, 1:], views)
        close(render(variables, volume, second), jax.tree.map(lambda x: x[:, 1:], both), rtol=1e-4, atol=1e-5)

    @pytest.mark.parametrize("ray_chunk", [7, 64, 1000])
    def test_rendering_in_chunks_is_rendering_at_once(self, variables, ray_chunk):
        volume = encode(variables, cloud())
        close(render(variables, volume, camera(), ray_chunk=ray_chunk), render(variables, volume, camera()))

    def test_rays_that_miss_the_box_are_exactly_white_and_carry_no_gradient(self, variables):
        away = camera(target=50.0)

        def total(variables, volume):
            rendering = training.render(variables, volume, away, config=CONFIG)
            return jnp.sum(rendering.image) + jnp.sum(rendering.depth), rendering

        volume = encode(variables, cloud())
        (_, rendering), gradients = jax.jit(jax.value_and_grad(total, (0, 1), has_aux=True))(variables, volume)
        assert (rendering.image == 1).all()
        assert (rendering.image_lr == 1).all()
        assert (rendering.acc == 0).all()
        assert (rendering.depth == 0).all()
        assert all((g == 0).all() for g in jax.tree.leaves(gradients))

    def test_an_opaque_volume_is_seen_at_its_face(self, variables):
        """Density is huge at every sample: opacity one, and the depth is that of the first sample."""
        solid = jax.tree.map(lambda x: x, variables)
        solid["params"]["field"]["head"]["bias"] = jnp.array([1e6, 0.0, 0.0, 0.0])
        rendering = render(solid, jnp.zeros((2, 8, 8, 8, 4)), camera())
        hit = np.asarray(rendering.depth) > 0
        assert hit.any()
        close(np.asarray(rendering.acc)[hit], np.ones(hit.sum()), atol=1e-5)

    def test_without_an_upsampler_the_image_is_the_rendering_and_no_upsampler_is_built(self, variables):
        assert set(variables["params"]) == {"pointnet", "unet", "field"}
        rendering = render(variables, encode(variables, cloud()), camera())
        same_bits(rendering.image, rendering.image_lr)

    @pytest.mark.parametrize(("resize", "size"), [(8, 16), (12, 24)])
    def test_with_fresh_weights_the_upsampler_shows_the_rendering_resized(self, variables, resize, size):
        config = dataclasses.replace(CONFIG, resize_resolution=resize, image_resolution=size)
        fresh = jax.jit(Renderer(config).init)(jax.random.key(2), cloud(), camera(size))
        assert "upsampler" in fresh["params"]
        merged = {"params": fresh["params"] | variables["params"], "batch_stats": variables["batch_stats"]}
        rendering = render(merged, encode(variables, cloud()), camera(size), config)
        low = render(variables, encode(variables, cloud()), camera())
        close(rendering.image_lr, low.image_lr, rtol=1e-4, atol=1e-5)
        expected = reference.bilinear(np.asarray(low.image_lr)[1, 0], resize, resize)
        close(rendering.image[1, 0], reference.bilinear(expected, size, size), atol=1e-4)


class TestJitter:
    def test_equal_keys_give_equal_bits_and_other_keys_other_samples(self, variables):
        first, again, other = (
            jittered(variables, cloud(), camera(), jax.random.key(seed))[0].image for seed in (3, 3, 4)
        )
        same_bits(first, again)
        assert (jnp.abs(first - other) > 1e-6).any()

    def test_equal_rays_of_two_views_get_their_own_samples(self, variables):
        twice = jax.tree.map(lambda x: jnp.concatenate([x[:, :1], x[:, :1]], axis=1), camera())
        image = jittered(variables, cloud(), twice, jax.random.key(5))[0].image
        assert (jnp.abs(image[:, 0] - image[:, 1]) > 1e-6).any()


class TestUnionWeights:
    coarse = jnp.sort(numbers(6, 2, 3, 5), axis=-1)
    fine = jnp.sort(numbers(7, 2, 3, 4), axis=-1)
    density = 3 * numbers(8, 2, 3, 9, low=0.0)
    far = jnp.full((2, 3), 1.5)

    def test_are_those_of_the_sorted_samples_put_back_in_their_places(self):
        weights = np.asarray(union_weights(self.coarse, self.fine, self.density, self.far))
        distances = np.concatenate([self.coarse, self.fine], axis=-1)
        for place in np.ndindex(2, 3):
            order = np.argsort(distances[place], kind="stable")
            delta = np.diff(np.append(distances[place][order], 1.5))
            expected = np.empty(9)
            expected[order], _ = reference.volume_weights(np.asarray(self.density)[place][order], delta)
            close(weights[place], expected)

    def test_obey_the_batch_law(self):
        batch_law(union_weights, self.coarse, self.fine, self.density, self.far)

    def test_gradients_by_the_density_are_right(self):
        gradient_law(lambda density: union_weights(self.coarse, self.fine, density, self.far), self.density)

    def test_a_fine_sample_on_top_of_a_coarse_one_changes_nothing(self):
        same = self.coarse[..., :4]
        density = jnp.concatenate([self.density[..., :5], self.density[..., :4]], axis=-1)
        weights = union_weights(self.coarse, same, density, self.far)
        alone = union_weights(self.coarse, self.coarse[..., :0], self.density[..., :5], self.far)
        close(weights[..., :4] + weights[..., 5:], alone[..., :4])
        close(weights[..., 4], alone[..., 4])
