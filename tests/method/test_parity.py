"""The paper's network, whole, against a PyTorch twin with the same weights: outputs, losses, statistics, gradients.

The twin's numbers were computed in float64; this code runs in float32 and must agree to 1e-4 of the norm.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import twin

from experiments.speed.bench import make_batch
from spnr_jax.kernels import cameras, losses
from spnr_jax.method import inference
from spnr_jax.method.paper_method import render_rays
from spnr_jax.training import optimisation

pytestmark = pytest.mark.ci
TOLERANCE = 1e-4
ARRAYS = twin.load()
CONFIG = twin.config(ARRAYS)
BATCH = jax.tree.map(jnp.asarray, make_batch(twin.inputs(ARRAYS)))
GENERATOR, DISCRIMINATOR = (twin.named(ARRAYS, f"param/{network}.") for network in ("gen", "disc"))
PARAMS, STATISTICS = twin.generator(GENERATOR)
VARIABLES = {"params": PARAMS, "batch_stats": STATISTICS}


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
    """Results of the generator in evaluation under their names in the fixture, from one program."""

    @jax.jit
    def run(variables, cloud, camera):
        module = inference.network(CONFIG.model).bind(variables)
        scene, rays = module.encode(cloud), module.rays(camera)
        features, depth, acc = render_rays(module, scene, rays, CONFIG.model.sampling, None, None)
        rendering = module.render(scene, camera)
        _, far, _ = cameras.intersect_box(rays.origins, rays.directions)

        def as_picture(x):  # (1, c, h, w), as the twin has it
            return jnp.moveaxis(x.reshape(1, 32, 32, -1), -1, 1)

        return {
            "point_features": module.encoder.point_features(cloud)[0],
            "volume": jnp.moveaxis(scene.volume, -1, 1),
            "features": as_picture(features),
            "rgb": as_picture(rendering.image_lr),
            "acc": as_picture(acc),
            "depth": as_picture(depth - (1 - acc) * far),  # ours adds the light that nothing stops, at `far`
            "image": jnp.moveaxis(rendering.image[:, 0], -1, 1),
        }

    return run(VARIABLES, BATCH.cloud, BATCH.camera)


@pytest.mark.parametrize("name", ["point_features", "volume", "features", "rgb", "acc", "depth", "image"])
def test_points_volume_and_pictures_of_the_generator_are_the_twins(stages, name):
    agree(stages[name], ARRAYS[f"eval/{name}"].reshape(stages[name].shape))


def judge(image):
    """Logits of the discriminator."""
    params = {"params": twin.discriminator(DISCRIMINATOR)}
    return optimisation.discriminator_of(CONFIG).apply(params, image, BATCH.condition[0], BATCH.condition_mask[0])


@pytest.mark.parametrize(("name", "source"), [("fake", "eval/image"), ("real", "in/target")])
def test_logits(name, source):
    agree(judge(jnp.asarray(pictures(source))), pictures(f"eval/logits_{name}"))


@pytest.fixture(scope="module")
def trained():
    """Rendering, losses, statistics and gradients of the generator in training, without jitter."""

    @jax.jit
    def run(named):
        def loss(named):
            variables = {"params": twin.generator(named)[0], "batch_stats": STATISTICS}
            rendering, updated = inference.network(CONFIG.model).apply(
                variables, BATCH.cloud, BATCH.camera, train=True, mutable=["batch_stats"]
            )
            l1 = inference.reconstruction_loss(CONFIG, rendering.image, rendering.image_lr, BATCH.image)
            adversarial = CONFIG.loss.adversarial_weight * losses.generator_adversarial(judge(rendering.image[:, 0]))
            parts = {"l1": l1, "adv": adversarial, "loss_g": l1 + adversarial}
            return l1 + adversarial, (rendering, updated["batch_stats"], parts)

        return jax.value_and_grad(loss, has_aux=True)(named)

    (_, (rendering, statistics, parts)), gradients = run(GENERATOR)
    return rendering, statistics, parts, gradients


def test_images_losses_and_statistics_of_the_training(trained):
    rendering, statistics, losses_of, _ = trained
    agree(rendering.image[:, 0], pictures("train/image"))
    agree(rendering.image_lr[:, 0], pictures("train/rgb"))
    far = ARRAYS["eval/far"].reshape(1, 32, 32, 1)
    acc, depth = (np.asarray(x)[:, 0, ..., None] for x in (rendering.acc, rendering.depth))
    agree(acc, pictures("train/acc"))
    agree(depth - (1 - acc) * far, pictures("train/depth"))
    for name in ("l1", "adv", "loss_g"):
        agree(losses_of[name], ARRAYS[f"train/{name}"])
    for layer in range(3):
        ours = statistics["encoder"]["pointnet"][f"norm_{layer}"]
        agree(ours["mean"], ARRAYS[f"train/after/points.norms.{layer}.running_mean"])
        agree(ours["variance"], ARRAYS[f"train/after/points.norms.{layer}.running_var"])


def test_gradients_of_every_parameter(trained):
    """The norms of all, and those that are stored in full."""
    norms = twin.named(ARRAYS, "train/grad_norm/gen.")
    assert set(trained[3]) - set(norms) == {name for name in GENERATOR if "running" in name}
    for name, norm in norms.items():
        agree(np.linalg.norm(trained[3][name]), norm)
    for name, gradient in twin.named(ARRAYS, "train/grad/gen.").items():
        agree(trained[3][name], gradient)


@pytest.fixture(scope="module")
def discriminated():
    """Loss and R1 penalty of the discriminator on the twin's training image, each with its gradients."""
    fake = jnp.asarray(pictures("train/image"))
    real, condition, mask = BATCH.image[0], BATCH.condition[0], BATCH.condition_mask[0]
    module = optimisation.discriminator_of(CONFIG)

    def loss(named):  # step 1, where no R1 is due
        return optimisation.discriminator_loss(CONFIG, twin.discriminator(named), fake, BATCH, jnp.int32(1))[0]

    def penalty(named):
        params = {"params": twin.discriminator(named)}
        r1 = losses.r1(lambda image: module.apply(params, image, condition, mask), real)
        return CONFIG.loss.r1_gamma * r1

    return {name: jax.jit(jax.value_and_grad(f))(DISCRIMINATOR) for name, f in (("loss_d", loss), ("r1", penalty))}


@pytest.mark.parametrize(("name", "key"), [("loss_d", "grad_norm"), ("r1", "grad_norm_r1")])
def test_losses_and_gradient_norms_of_the_discriminator(discriminated, name, key):
    agree(discriminated[name][0], ARRAYS[f"train/{name}"])
    stored = twin.named(ARRAYS, f"train/{key}/disc.")
    assert len(stored) == 13
    for parameter, norm in stored.items():
        agree(np.linalg.norm(discriminated[name][1][parameter]), norm)
