"""Training with settings and batches that nobody meant: finite to its end, or stopped with step and quantity."""

import dataclasses
import functools
import re
from contextlib import closing

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset, tiny_training
from support.tiny_baselines import NETWORKS

from spnr_jax.config import LossConfig, OptimizerConfig, TrainConfig
from spnr_jax.formats import data_sets
from spnr_jax.kernels import losses
from spnr_jax.method import inference
from spnr_jax.methods import METHODS
from spnr_jax.presets import abo, shapenet_chair, small, tiny
from spnr_jax.training import batching, optimisation, run_record, trainer

pytestmark = pytest.mark.ci  # it trains several networks

EVERY_STEP = trainer.Schedule(log_every=1, preview_every=100, checkpoint_every=100)
NAMED = re.compile(r"(\w+) is (?:nan|inf|-inf) at step (\d+); the last checkpoint is kept")
TAME = dataclasses.replace(
    tiny_dataset.CONFIG,
    loss=LossConfig(discriminator_width=4, r1_interval=2),
    optimizer=OptimizerConfig(lr_generator=2e-3, warmup_steps=2),
    num_steps=20,
)


def with_rates(config: TrainConfig, factor: float) -> TrainConfig:
    """The config with both learning rates so many times higher."""
    o = config.optimizer
    rates = {"lr_generator": factor * o.lr_generator, "lr_discriminator": factor * o.lr_discriminator}
    return dataclasses.replace(config, optimizer=dataclasses.replace(o, **rates))


def with_losses(config: TrainConfig, **weights: float) -> TrainConfig:
    """The config with other weights in its loss."""
    return dataclasses.replace(config, loss=dataclasses.replace(config.loss, **weights))


WILD_WEIGHTS = {"l1_weight": 1e6, "adversarial_weight": 1e6}
WILD = with_losses(with_rates(TAME, 100), **WILD_WEIGHTS)
HOPELESS = with_losses(with_rates(TAME, 1e30), adversarial_weight=0.0)


def assert_finite(tree):
    """No number of the tree is NaN or infinite; the message names its place."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


def train_to_the_end_or_a_name(config, dataset, run) -> str | None:
    """The quantity that stopped the training, None if it reached its end; every step before has a finite row."""
    try:
        state = trainer.train(config, dataset, run, EVERY_STEP)
    except trainer.NotFinite as error:
        quantity, step = NAMED.match(str(error)).groups()
        whole = int(step) - 1
    else:
        assert_finite(state)
        updates = state.generator_optimizer[0].count, state.discriminator_optimizer[0].count
        assert updates == (config.num_steps, config.num_steps - optimisation.first_adversarial_step(config))
        quantity, whole = None, config.num_steps
    rows = [row for row in run_record.read_rows(run) if "loss" in row]
    assert [row["step"] for row in rows] == list(range(1, whole + 1))
    assert all(np.isfinite(value) for row in rows for value in row.values())
    return quantity


@pytest.mark.parametrize("config", [WILD, pytest.param(HOPELESS, marks=pytest.mark.slow)], ids=["wild", "hopeless"])
def test_training_with_wild_settings_is_finite_to_its_end_or_stops_by_name(config, tmp_path):
    """Learning rates a hundred times too high and both losses weighted with a million; rates beyond all hope."""
    stopped = train_to_the_end_or_a_name(config, tiny_dataset.dataset(), tmp_path)
    assert (stopped is None) == (config is WILD)


def empty(batch):
    """The batch with white references, on which no input point is seen."""
    nothing = jnp.zeros_like(batch.condition)
    return dataclasses.replace(
        batch, image=nothing + 1, condition=nothing, condition_mask=jnp.zeros_like(batch.condition_mask)
    )


def of_one_point(batch):
    """The batch with clouds of one point each."""
    mask = jnp.broadcast_to(jnp.arange(batch.cloud.mask.shape[-1]) == 3, batch.cloud.mask.shape)
    return dataclasses.replace(batch, cloud=dataclasses.replace(batch.cloud, mask=mask))


def of_no_point(batch):
    """The batch with clouds of padding alone."""
    cloud = dataclasses.replace(batch.cloud, mask=jnp.zeros_like(batch.cloud.mask))
    return dataclasses.replace(batch, cloud=cloud)


BATCHES = {
    "as it is": lambda batch: batch,
    "empty images": empty,
    "one point": of_one_point,
    "no point": of_no_point,
    "one point on empty images": lambda batch: empty(of_one_point(batch)),
    "black": lambda batch: dataclasses.replace(batch, image=jnp.zeros_like(batch.image)),
}


@functools.cache
def first_batch():
    """A training batch of the painted balls, shared by TAME and WILD."""
    with closing(batching.batches(tiny_dataset.dataset(), TAME, 0)) as batches:
        return jax.tree.map(jnp.asarray, next(batches))


@pytest.mark.parametrize("name", BATCHES)
def test_both_networks_stay_finite_in_twenty_steps_on(name):
    state, batch = optimisation.jitted_create_state(WILD), BATCHES[name](first_batch())
    for _ in range(20):
        state, metrics = optimisation.jitted_train_step(state, batch, config=WILD, adversarial=True)
        assert_finite(metrics)
    assert_finite(state)


def shrunken(config: TrainConfig, precision: str, num_steps: int) -> TrainConfig:
    """A preset with its own stages, passes, losses and schedule, at 16 rays a side and the narrowest layers."""
    m, smaller = config.model, config.model.render_resolution // 16
    encoder = dataclasses.replace(
        m.encoder,
        point_widths=tuple(width // 16 for width in m.encoder.point_widths),
        point_features=4,
        volume_resolution=2**m.encoder.num_stages,
        base_width=2,
        num_groups=min(m.encoder.num_groups, 2),
    )
    sizes = {f"{n}_resolution": getattr(m, f"{n}_resolution") // smaller for n in ("render", "resize", "image")}
    model = dataclasses.replace(
        m,
        encoder=encoder,
        field_width=8,
        num_features=5,
        sampling=dataclasses.replace(m.sampling, num_coarse=4, num_fine=4),
        upsampler_width=4,
        precision=precision,
        **sizes,
    )
    loss = dataclasses.replace(config.loss, discriminator_width=4, r1_interval=2)
    return shortened(dataclasses.replace(config, model=model, loss=loss), num_steps)


def shrunken_baseline(config: TrainConfig, num_steps: int) -> TrainConfig:
    """A baseline's preset with its own units, losses and schedule, 8 pixels a side and the narrowest layers."""
    small = next(model for model in NETWORKS.values() if isinstance(model, type(config.model)))
    kept = ("near", "radius", "jitter", "density_scale", "kl_weight", "materials")
    kept = {name: getattr(config.model, name) for name in kept if hasattr(config.model, name)}
    model = dataclasses.replace(small, **kept, image_resolution=8 * config.pixel_stride)
    return shortened(dataclasses.replace(config, model=model), num_steps)


def shortened(config: TrainConfig, num_steps: int) -> TrainConfig:
    """The config with few steps on few points of two objects."""
    return dataclasses.replace(
        config,
        optimizer=dataclasses.replace(config.optimizer, warmup_steps=min(config.optimizer.warmup_steps, 2)),
        num_steps=num_steps,
        batch_objects=2,
        min_points=8,
        max_points=32,
    )


def images_of(config: TrainConfig, folder):
    """The painted balls at the size that a config needs."""
    return data_sets.open_dataset(tiny_dataset.write_dataset(folder, size=config.model.image_resolution))


def train_under_debug_nans(config: TrainConfig, dataset):
    """State after the config's steps while JAX looks for NaN in whatever a compiled function returns."""
    with jax.debug_nans(True), closing(batching.batches(dataset, config, 0)) as batches:
        state = optimisation.jitted_create_state(config)
        for step, batch in enumerate(batches):
            adversarial = step >= optimisation.first_adversarial_step(config)
            state, metrics = optimisation.jitted_train_step(
                state, jax.device_put(batch), config=config, adversarial=adversarial
            )
            assert_finite(metrics)
    assert_finite(state)
    return state


class TestNoNaN:
    def test_a_few_steps_of_shrunken_tiny_make_none(self, tmp_path):
        config = with_losses(shrunken(tiny(), "float32", 4), adversarial_weight=0.0)
        assert train_under_debug_nans(config, images_of(config, tmp_path)).step == 4

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("preset", "precision"), [(abo, "bfloat16"), (shapenet_chair, "float32"), (small, "bfloat16")]
    )
    def test_twenty_steps_of_shrunken_presets_make_none(self, preset, precision, tmp_path):
        config = shrunken(preset(), precision, 20)
        assert optimisation.first_adversarial_step(config) in range(1, 20), "both phases are trained"
        assert train_under_debug_nans(config, images_of(config, tmp_path)).step == 20

    @pytest.mark.slow
    @pytest.mark.parametrize("preset", [preset for method in METHODS.values() for preset in method.presets])
    def test_twenty_steps_of_each_shrunken_baseline_make_none(self, preset, tmp_path):
        config = shrunken_baseline(preset(), 20)
        assert train_under_debug_nans(config, images_of(config, tmp_path)).step == 20


@pytest.mark.slow
def test_no_seed_of_twenty_has_a_dead_density():
    """Fifty steps leave the balls opaque, from whatever weights and jitter they began."""
    config, batch, seeds = tiny_training.L1_ONLY, tiny_training.BATCH, jax.random.key(5)

    def begin(key):
        init_key, step_key = jax.random.split(key)
        variables = inference.network(config.model).init(init_key, *inference.example_inputs(config.model))
        fresh = tiny_training.create(config)
        return dataclasses.replace(fresh, key=step_key, generator=variables["params"])

    @jax.jit
    @jax.vmap
    def step(state):
        return optimisation.train_step(state, batch, config=config, adversarial=False)[0]

    @jax.jit
    @jax.vmap
    def opacity(state):
        variables = {"params": state.generator, "batch_stats": state.batch_stats}
        acc = inference.network(config.model).apply(variables, batch.cloud, batch.camera).acc
        white = losses.area_downsample(batch.image, config.model.render_resolution)
        return jnp.mean(acc, where=(white < 0.99).any(axis=-1))

    states = jax.jit(jax.vmap(begin))(jax.random.split(seeds, 20))
    for _ in range(50):
        states = step(states)
    assert (opacity(states) > 0.1).all(), opacity(states)
