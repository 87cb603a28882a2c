"""The generator as a whole, shrunken: what must not change its pictures, and what must."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_model
from support.laws import close, same_bits
from support.tiny_model import NUM_POINTS, camera, cloud

from spnr_jax.config import MATERIAL_CHANNELS
from spnr_jax.kernels import cameras, sampling, voxels
from spnr_jax.kernels.cameras import intersect_box
from spnr_jax.kernels.records import Rays, Scene
from spnr_jax.method import inference
from spnr_jax.nn.paper_layers import Encoder

CONFIG = tiny_model.WITHOUT_UPSAMPLER
NEAR = dataclasses.replace(CONFIG, sampling=dataclasses.replace(CONFIG.sampling, reach=1))
open_path = jax.jit(voxels.open_path, static_argnames="num_cells")


@pytest.fixture(scope="module")
def variables():
    return tiny_model.variables()


def encode(variables, cloud):
    return tiny_model.encode(variables, cloud, config=CONFIG)


@pytest.fixture(scope="module")
def encoded(variables):
    return encode(variables, cloud())


def render(variables, volume, camera):
    return tiny_model.render(variables, volume, camera, config=CONFIG)


@jax.jit
def jittered(variables, cloud, camera, key):
    return inference.network(CONFIG).apply(variables, cloud, camera, key, train=True, mutable=["batch_stats"])


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

    def test_what_fills_the_padding_does_not_reach_the_gradient(self, variables):
        @jax.jit
        def gradient(cloud):
            def total(params):
                module = inference.network(CONFIG).bind({**variables, "params": params})
                features = module.encoder.point_features(cloud)
                return jnp.sum(jnp.where(cloud.mask[..., None], features, 0) ** 2)

            return jax.grad(total)(variables["params"])["encoder"]["pointnet"]

        mask = cloud().mask.at[:, 5:].set(False)
        zeros, spoilt = (
            jax.tree.map(
                lambda x, fill=fill: jnp.where(mask.reshape(*mask.shape, *[1] * (x.ndim - 2)), x, fill), cloud()
            )
            for fill in (0, jnp.nan)
        )
        zeros, spoilt = (dataclasses.replace(c, mask=mask) for c in (zeros, spoilt))
        close(gradient(spoilt), gradient(zeros))

    def test_in_evaluation_an_object_does_not_see_the_others(self, variables):
        other = jax.tree.map(lambda x: x.at[0].set(x[1]), (cloud(), camera()))
        one, two = (render(variables, encode(variables, c), view) for c, view in ((cloud(), camera()), other))
        close(two, jax.tree.map(lambda x: x[jnp.array([1, 1])], one), rtol=1e-4, atol=1e-5)

    @pytest.mark.parametrize("materials", [(), ("roughness",), ("base_color", "metallic")], ids=str)
    def test_materials_that_the_config_leaves_out_are_not_read(self, materials):
        module = Encoder(dataclasses.replace(CONFIG.encoder, materials=materials))
        unread = {"base_color", "roughness", "metallic"} - set(materials)
        spoilt = dataclasses.replace(
            cloud(), **{name: jnp.full_like(getattr(cloud(), name), jnp.nan) for name in unread}
        )
        inputs = module.apply({}, spoilt, method="point_inputs")
        assert inputs.shape[-1] == 6 + sum(MATERIAL_CHANNELS[name] for name in materials)
        assert jnp.isfinite(inputs).all()
        names = iter(range(6, inputs.shape[-1]))
        for name in materials:
            given = np.asarray(getattr(cloud(), name)).reshape(2, NUM_POINTS, -1)
            close(np.asarray(inputs)[..., [next(names) for _ in range(given.shape[-1])]], given, rtol=0)


class TestViews:
    def test_rays_do_not_know_their_block(self, variables):
        """To a few roundings: a matrix product of another size adds in another order."""
        volume = encode(variables, cloud())
        in_sevens = jax.jit(lambda *given: inference.network(CONFIG).bind(variables).draw(*given, block=7))
        part = in_sevens(volume, camera())
        close(part, render(variables, volume, camera()), rtol=1e-6, atol=1e-6)
        same_bits(in_sevens(volume, camera()), part)

    def test_samples_of_rays_that_graze_an_edge_stay_in_the_box(self, variables):
        """Their way through it is shorter than the rounding of a position, and outside there would be nothing."""
        rng = np.random.default_rng(8)
        edge = np.float32([1, 1, 0]) * (1 - 1e-6 * rng.random((1000, 1))) + np.float32([0, 0, 0.9]) * rng.random(
            (1000, 1)
        )
        directions = np.float32([-1, 1, 0]) + 0.3 * rng.normal(size=(1000, 3))
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        rays = Rays(origins=jnp.float32(edge - 7 * directions)[None], directions=jnp.float32(directions)[None])
        near, far, hit = map(np.asarray, intersect_box(rays.origins, rays.directions))
        assert hit.sum() > 100
        assert np.median((far - near)[hit]) < 1e-5

        @jax.jit
        def densities(rays, distances):
            module = inference.network(CONFIG).bind(variables)
            everywhere = Scene(volume=jnp.ones((1, 8, 8, 8, 4)), occupied=jnp.ones((1, 8, 8, 8), bool))
            field, _ = module.make_field(everywhere, rays, jnp.zeros(rays.origins.shape[:-1], jnp.int32))
            return field(distances).density

        found = np.asarray(densities(rays, jnp.asarray((near + far) / 2)[..., None]))[..., 0][hit]
        close(found, np.full(found.shape, found[0]))


class TestJitter:
    def test_coarse_and_fine_samples_draw_numbers_of_their_own(self, variables, monkeypatch):
        drawn, strata = [], sampling.strata
        monkeypatch.setattr(sampling, "strata", lambda *a: (drawn.append(strata(*a)), drawn[-1])[1])

        @jax.jit
        def numbers_drawn(key):
            inference.network(CONFIG).apply(variables, cloud(), camera(), key)
            return tuple(drawn)

        coarse, fine = numbers_drawn(jax.random.key(6))
        assert coarse.shape == fine.shape
        assert (coarse != fine).mean() > 0.99

    def test_equal_rays_of_two_views_get_their_own_samples(self, variables):
        twice = jax.tree.map(lambda x: jnp.concatenate([x[:, :1], x[:, :1]], axis=1), camera())
        image = jittered(variables, cloud(), twice, jax.random.key(5))[0].image
        assert (jnp.abs(image[:, 0] - image[:, 1]) > 1e-6).any()


class TestEmptySpace:
    @pytest.mark.ci
    def test_a_box_that_is_open_everywhere_is_rendered_as_without_skipping_and_so_is_its_gradient(
        self, variables, encoded
    ):
        def total(volume, config):
            everywhere = Scene(volume=volume, occupied=jnp.ones_like(encoded.occupied))
            rendering = inference.render(variables, everywhere, camera(), config=config)
            return jnp.sum(jnp.sin(rendering.image)) + jnp.sum(rendering.acc), rendering

        both = jax.jit(jax.value_and_grad(total, has_aux=True), static_argnums=1)
        ((_, expected), wanted), ((_, ours), gradient) = (both(encoded.volume, c) for c in (CONFIG, NEAR))
        close(ours, expected, atol=2e-4)
        assert (np.asarray(expected.depth) > 0).any()
        assert np.linalg.norm(gradient - wanted) < 1e-3 * np.linalg.norm(wanted)

    def test_rays_that_miss_the_points_are_white_and_transparent(self, variables, encoded):
        rendering = tiny_model.render(variables, encoded, camera(), config=NEAR)
        rays = cameras.view_rays(cameras.resize(camera(), *rendering.acc.shape[-2:]))
        near, far, _ = jax.jit(cameras.intersect_box)(rays.origins, rays.directions)
        cells = 2 * CONFIG.encoder.volume_resolution
        path = open_path(voxels.dilate(encoded.occupied, 1), rays, near, far, num_cells=cells)
        missed = np.asarray(path.travelled[..., -1] == 0).reshape(rendering.acc.shape)
        assert missed.any()
        assert not missed.all()
        assert (np.asarray(rendering.image)[missed] == 1).all()
        assert (np.asarray(rendering.acc)[missed] == 0).all()
        close(np.asarray(rendering.depth)[missed], np.asarray(far).reshape(missed.shape)[missed])

    def test_what_a_ray_draws_does_not_depend_on_the_rays_beside_it(self, variables, encoded):
        """Devices of a mesh pack their own rays into blocks: a step must draw there what it draws on one device."""
        generic = camera(target=0.013)

        @partial(jax.jit, static_argnames="block")
        def jittered(key, block):
            return inference.network(NEAR).bind(variables).draw(encoded, generic, block, key)

        few, many = (jittered(jax.random.key(0), block) for block in (7, 256))
        close(few, many, atol=1e-5)
        still = tiny_model.render(variables, encoded, generic, config=NEAR)
        assert np.abs(np.asarray(many.image) - np.asarray(still.image)).max() > 1e-3, "a key moves the samples"

    def test_occupied_voxels_are_those_of_the_points(self, encoded):
        points, resolution = cloud(), CONFIG.encoder.volume_resolution
        _, occupancy = voxels.scatter_mean(points.positions, points.base_color, points.mask, resolution)
        same_bits(encoded.occupied, occupancy > 0)
