"""Every stage against a PyTorch twin with the same weights: outputs, losses, statistics, gradients.

The twin's numbers were computed in float64; this code runs in float32 and must agree to 1e-4 of the norm.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import twin

from experiments.speed.bench import make_batch
from spnr_jax.kernels import losses
from spnr_jax.method import inference
from spnr_jax.training import optimisation

TOLERANCE = 1e-4
ARRAYS = twin.load()
CONFIG = twin.config(ARRAYS)
BATCH = jax.tree.map(jnp.asarray, make_batch(twin.inputs(ARRAYS)))
GENERATOR, STATISTICS = twin.generator(ARRAYS)
DISCRIMINATOR = twin.discriminator(ARRAYS)
VARIABLES = {"params": GENERATOR, "batch_stats": STATISTICS}


def agree(ours, theirs, tolerance=TOLERANCE):
    """The norm of the difference is a 10 000th of the norm."""
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    assert ours.shape == theirs.shape
    assert np.linalg.norm(ours - theirs) <= tolerance * np.linalg.norm(theirs)


def pictures(key):
    """An image stack of the fixture (1, c, h, w) as (1 view, h, w, c)."""
    return np.moveaxis(ARRAYS[key], 1, -1)


@pytest.fixture(scope="module")
def stages():
    """The generator in evaluation: results under their names in the fixture and in its layout."""

    @jax.jit
    def run(variables, cloud, camera):
        module = inference.network(CONFIG.model).bind(variables)
        scene = module.encode(cloud)
        return module.encoder.point_features(cloud)[0], scene.volume, module.render(scene, camera)

    point_features, volume, rendering = run(VARIABLES, BATCH.cloud, BATCH.camera)
    acc, depth = visible(rendering)
    views = {"rgb": rendering.image_lr[:, 0], "acc": acc, "depth": depth, "image": rendering.image[:, 0]}
    channels_last = {"volume": volume, **views}
    return {"point_features": point_features} | {name: np.moveaxis(x, -1, 1) for name, x in channels_last.items()}


def visible(rendering):
    """Opacity and depth of the view as the twin has them: ours adds the light that nothing stops, at `far`."""
    acc, depth = (np.asarray(x)[:, 0, ..., None] for x in (rendering.acc, rendering.depth))
    return acc, depth - (1 - acc) * ARRAYS["eval/far"].reshape(1, 32, 32, 1)


@pytest.mark.parametrize("name", ["point_features", "volume", "rgb", "acc", "depth", "image"])
def test_every_stage_of_the_generator_is_the_twins(stages, name):
    agree(stages[name], ARRAYS[f"eval/{name}"].reshape(stages[name].shape))


@pytest.mark.parametrize(("name", "source"), [("fake", "eval/image"), ("real", "in/target")])
def test_logits(name, source):
    logits = optimisation.discriminator_of(CONFIG).apply(
        {"params": DISCRIMINATOR}, jnp.asarray(pictures(source)), BATCH.condition[0], BATCH.condition_mask[0]
    )
    agree(logits, pictures(f"eval/logits_{name}"))


def judge(params, image):
    logits = optimisation.discriminator_of(CONFIG).apply(
        {"params": params}, image[:, 0], BATCH.condition[0], BATCH.condition_mask[0]
    )
    return losses.generator_adversarial(logits)


@pytest.fixture(scope="module")
def trained():
    """Rendering, losses, statistics and gradients of the generator in training, without jitter."""

    @jax.jit
    def run(params):
        def loss(params):
            variables = {"params": params, "batch_stats": STATISTICS}
            rendering, updated = inference.network(CONFIG.model).apply(
                variables, BATCH.cloud, BATCH.camera, train=True, mutable=["batch_stats"]
            )
            l1 = inference.reconstruction_loss(CONFIG, rendering.image, rendering.image_lr, BATCH.image)
            adversarial = CONFIG.loss.adversarial_weight * judge(DISCRIMINATOR, rendering.image)
            parts = {"l1": l1, "adv": adversarial, "loss_g": l1 + adversarial}
            return l1 + adversarial, (rendering, updated["batch_stats"], parts)

        return jax.value_and_grad(loss, has_aux=True)(params)

    (_, (rendering, statistics, parts)), gradients = run(GENERATOR)
    return rendering, statistics, parts, gradients


def test_images_losses_and_statistics_of_the_training(trained):
    rendering, statistics, losses_of, _ = trained
    agree(rendering.image[:, 0], pictures("train/image"))
    agree(rendering.image_lr[:, 0], pictures("train/rgb"))
    for name, ours in zip(("acc", "depth"), visible(rendering), strict=True):
        agree(ours, pictures(f"train/{name}"))
    for name in ("l1", "adv", "loss_g"):
        agree(losses_of[name], ARRAYS[f"train/{name}"])
    for layer in range(3):
        ours = statistics["encoder"]["pointnet"][f"norm_{layer}"]
        agree(ours["mean"], ARRAYS[f"train/after/points.norms.{layer}.running_mean"])
        agree(ours["variance"], ARRAYS[f"train/after/points.norms.{layer}.running_var"])


def test_gradients_of_every_parameter(trained):
    """The norms of all, and those that are stored in full."""
    norms, stored = (
        {name.removeprefix(begin): x for name, x in ARRAYS.items() if name.startswith(begin)}
        for begin in ("train/grad_norm/gen.", "train/grad/gen.")
    )
    ours = twin_named(lambda named: twin.generator(named)[0], "param/gen.", trained[3])
    assert set(norms) == {name for name in ours if "running" not in name}
    for name, norm in norms.items():
        agree(np.linalg.norm(ours[name]), norm)
    for name, gradient in stored.items():
        agree(ours[name], gradient)


def twin_named(convert, prefix, gradients):
    """Gradients under the twin's names and in its layout: through the conversion of its weights to ours."""
    named = {name: jnp.asarray(x) for name, x in ARRAYS.items() if name.startswith(prefix)}
    (found,) = jax.vjp(convert, named)[1](gradients)
    return {name.removeprefix(prefix): np.asarray(x) for name, x in found.items()}


@pytest.fixture(scope="module")
def discriminated():
    """Loss and R1 penalty of the discriminator on the twin's training image, each with its gradients."""
    fake = jnp.asarray(pictures("train/image"))
    real, condition, mask = BATCH.image[0], BATCH.condition[0], BATCH.condition_mask[0]
    module = optimisation.discriminator_of(CONFIG)

    def loss(params):  # step 1, where no R1 is due
        return optimisation.discriminator_loss(CONFIG, params, fake, BATCH, jnp.int32(1))[0]

    def penalty(params):
        r1 = losses.r1(lambda image: module.apply({"params": params}, image, condition, mask), real)
        return CONFIG.loss.r1_gamma * r1

    return {name: jax.jit(jax.value_and_grad(f))(DISCRIMINATOR) for name, f in (("loss_d", loss), ("r1", penalty))}


@pytest.mark.parametrize(("name", "key"), [("loss_d", "grad_norm"), ("r1", "grad_norm_r1")])
def test_losses_and_gradient_norms_of_the_discriminator(discriminated, name, key):
    agree(discriminated[name][0], ARRAYS[f"train/{name}"])
    stored = {k.split("disc.")[1]: v for k, v in ARRAYS.items() if k.startswith(f"train/{key}/disc.")}
    assert len(stored) == 13
    ours = twin_named(twin.discriminator, "param/disc.", discriminated[name][1])
    for parameter, norm in stored.items():
        agree(np.linalg.norm(ours[parameter]), norm)
