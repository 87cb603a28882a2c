"""The network that sees the nearest points: both ways through its renderer, its training, its config."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_model, tiny_training
from support.laws import close, same_bits
from support.tiny_model import PLUS, camera, cloud, wobbled

from spnr_jax import presets
from spnr_jax.config import AS_TRAINED, LossConfig, OptimizerConfig, RenderOptions, SamplingConfig, surface_grid
from spnr_jax.kernels import occupancy
from spnr_jax.method import inference
from spnr_jax.method.march import trace
from spnr_jax.method.model import Model
from spnr_jax.training import pixels

GENERIC = camera(target=0.0171)  # no cell has its middle on a face between cells, where rounding would decide


@pytest.fixture(scope="module", params=["lit", "free"])
def config(request):
    return dataclasses.replace(PLUS, color=request.param)


@pytest.fixture(scope="module")
def variables(config):
    return wobbled(jax.jit(inference.network(config).init)(jax.random.key(0), cloud(), camera()), 4)


@pytest.fixture(scope="module")
def scene(config, variables):
    return inference.jitted_encode(variables, cloud(), config=config)


def render(variables, scene, config, camera=GENERIC, **options):
    return inference.jitted_render(variables, scene, camera, config=config, **options)


class TestRendering:
    def test_open_cells_are_those_that_know_a_point(self, config, variables, scene):
        known = scene.surface.nearest[..., 0] < tiny_model.NUM_POINTS
        same_bits(occupancy.dilate(scene.occupied, 1), known)
        assert 0 < np.mean(known) < 1
        assert known.shape[1] == surface_grid(tiny_model.NUM_POINTS)

    def test_a_box_that_is_open_everywhere_is_rendered_as_without_skipping(self, config, variables, scene):
        everywhere = dataclasses.replace(scene, occupied=jnp.ones_like(scene.occupied))

        @jax.jit
        def both(everywhere):
            module = inference.network(config).bind(variables)
            reaches = config.sampling, dataclasses.replace(config.sampling, reach=0)
            return [trace(module, everywhere, module.rays(GENERIC), samples, AS_TRAINED, None) for samples in reaches]

        ours, expected = both(everywhere)
        assert (np.asarray(expected[2]) > 0.5).any()
        close(ours, expected, atol=5e-4)

    def test_the_picture_of_an_object_does_not_know_what_is_beside_it(self, config, variables, scene):
        second = jax.tree.map(lambda x: x[1:], (scene, GENERIC))
        whole, alone = render(variables, scene, config), render(variables, *second[:1], config, second[1])
        close(alone, jax.tree.map(lambda x: x[1:], whole), atol=1e-5)
        mapped = jax.jit(
            jax.vmap(
                lambda scene, camera: inference.render(
                    variables, *jax.tree.map(lambda x: x[None], (scene, camera)), config=config
                )
            )
        )(scene, GENERIC)
        close(jax.tree.map(lambda x: x[:, 0], mapped), whole, atol=1e-5)

    @pytest.mark.parametrize("block", [7, 300])
    def test_the_block_does_not_matter(self, config, variables, scene, block):
        whole, chunked = (render(variables, scene, config, options=RenderOptions(block=n)) for n in (4096, block))
        close(chunked, whole, atol=1e-5)

    def test_the_order_of_the_points_and_what_fills_the_padding_do_not_matter(self, config, variables):
        points = cloud()
        half = dataclasses.replace(points, mask=points.mask.at[:, 20:].set(False))
        order = np.random.default_rng(0).permutation(tiny_model.NUM_POINTS)
        mixed = jax.tree.map(lambda x: x[:, order], half)
        nonsense = jax.tree.map(lambda x: x if x.dtype == bool else x.at[:, 20:].set(-3.0), half)
        one, *others = (
            render(variables, inference.jitted_encode(variables, c, config=config), config)
            for c in (half, mixed, nonsense)
        )
        for other in others:
            close(other, one, atol=1e-4)

    def test_no_point_gives_a_white_picture(self, config, variables):
        empty = dataclasses.replace(cloud(), mask=jnp.zeros_like(cloud().mask))
        rendering = render(variables, inference.jitted_encode(variables, empty, config=config), config)
        assert (rendering.image == 1).all()

    def test_a_cloud_turned_by_a_quarter_with_its_camera_keeps_its_silhouette_where_the_volume_says_nothing(
        self, config, variables
    ):
        """Heights, distances and planes turn with the object; the view of the axes by the network is cut."""
        blind = jax.tree.map(jnp.zeros_like, variables["params"]["field"]["near"]["kernel"])
        told = (
            jnp.arange(len(blind)) - config.encoder.base_width
        )  # rows: volume, then 12 scalars, normal, colour, mirrored
        kernel = jnp.where(((told >= 0) & (told < 12))[:, None], variables["params"]["field"]["near"]["kernel"], blind)
        field = variables["params"]["field"] | {"near": variables["params"]["field"]["near"] | {"kernel": kernel}}
        variables = variables | {"params": variables["params"] | {"field": field}}
        turn = jnp.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        points = cloud()
        turned = dataclasses.replace(points, positions=points.positions @ turn.T)
        pose = jnp.einsum("ij,...jk->...ik", turn, GENERIC.cam_to_world)
        turned_camera = dataclasses.replace(GENERIC, cam_to_world=pose)
        one, other = (
            render(variables, inference.jitted_encode(variables, c, config=config), config, view).acc
            for c, view in ((points, GENERIC), (turned, turned_camera))
        )
        assert np.mean(np.abs(np.asarray(one - other)) > 0.02) < 0.02  # but for rays along the faces of cells


class TestHandle:
    def test_every_quality_is_a_picture(self, config, variables):
        model = Model(config=config, variables=variables)
        single = jax.tree.map(lambda x: np.asarray(x[0]), cloud())
        volume = model.encode(single)
        pictures = [model.render(volume, model.camera(volume), quality) for quality in ("draft", "best", "trained")]
        assert all((np.asarray(p.acc) > 0.1).any() for p in pictures)
        same_bits(pictures[1], pictures[2])  # such a network is trained at its best


@pytest.mark.ci
class TestTraining:
    def test_learns_two_balls_and_their_opacity(self):
        config = dataclasses.replace(
            tiny_training.L1_ONLY,
            model=dataclasses.replace(PLUS, image_resolution=tiny_model.SIZE),
            loss=LossConfig(l1_weight=1.0, mse_weight=2.0, adversarial_weight=0.0, opacity_weight=0.5),
            optimizer=OptimizerConfig(lr_generator=5e-3, warmup_steps=4),
            pixel_stride=2,
        )
        first, metrics = tiny_training.run(tiny_training.create(config), 1, config)
        _, later = tiny_training.run(first, 75, config)
        squared = (metrics["loss"] - metrics["l1"] - metrics["opacity"]) / 2
        assert metrics["l1"] ** 2 < squared < metrics["l1"]
        assert later["opacity"] < 0.5 * metrics["opacity"]
        assert later["psnr"] > metrics["psnr"] + 3

    def test_the_opacity_that_is_learnt_is_that_of_the_thinned_pixels(self):
        batch = tiny_training.BATCH
        thinned = pixels.lattice(jax.random.key(3), batch, 3)
        # the balls are opaque where they are not white
        same_bits(thinned.alpha > 0, (thinned.image != 1).any(axis=-1))
        assert thinned.alpha.shape == thinned.image.shape[:-1]


class TestConfig:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"sampling": SamplingConfig(num_coarse=4, reach=0)}, "use reach 1"),
            ({"sampling": SamplingConfig(num_coarse=4, reach=2)}, "use reach 1"),
        ],
    )
    def test_what_does_not_go_together_is_refused(self, changes, message):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(PLUS, **changes)

    def test_the_grid_of_a_training_is_at_least_that_of_its_clouds(self):
        config = presets.near_points_tiny()
        with pytest.raises(ValueError, match="surface_cells 32: with max_points 2048 .* use at least 45"):
            dataclasses.replace(config, max_points=2048)
        dataclasses.replace(config, max_points=2048, model=dataclasses.replace(config.model, surface_cells=45))
