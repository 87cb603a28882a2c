"""Every stage against a PyTorch twin with the same weights: outputs, losses, statistics, gradients.

The twin's numbers were computed in float64; this code runs in float32 and must agree to 1e-4 of the norm.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import twin

from experiments.speed.bench import make_batch
from spnr_jax.kernels import cameras, compositing, losses, sampling, voxels
from spnr_jax.method import inference
from spnr_jax.method.paper_method import render_rays
from spnr_jax.nn.paper_layers import encode_direction
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
    """Every intermediate result of the generator in evaluation under its name in the fixture, from one program."""

    @jax.jit
    def run(variables, cloud, camera):
        module = inference.network(CONFIG.model).bind(variables)
        resolution, counts = CONFIG.model.encoder.volume_resolution, CONFIG.model.sampling
        point_features = module.encoder.point_features(cloud)
        scene = module.encode(cloud)
        rays = module.rays(camera)
        near, far, _ = cameras.intersect_box(rays.origins, rays.directions)
        objects = jnp.zeros(rays.origins.shape[:-1], jnp.int32)
        coarse, edges = sampling.stratified(None, near, far, counts.num_coarse)
        positions = rays.origins[..., None, :] + coarse[..., None] * rays.directions[..., None, :]
        density, (rgb, _) = module.make_field(scene, rays, objects)[0](coarse)
        weights, _ = compositing.volume_weights(density, compositing.interval_lengths(coarse, far))
        features, depth, acc = render_rays(module, scene, rays, counts, None, None)
        cell, offset = voxels.locate(cloud.positions, resolution)
        grid, occupancy = voxels.scatter_mean(cloud.positions, point_features, cloud.mask, resolution)
        rendering = module.render(scene, camera)
        encoding = encode_direction(rays.directions, CONFIG.model.direction_frequencies)

        def as_picture(x):  # (1, c, h, w), as the twin has it
            return jnp.moveaxis(x.reshape(1, 32, 32, -1), -1, 1)

        return {
            "voxel_index": (cell[0, :, 2] * resolution + cell[0, :, 1]) * resolution + cell[0, :, 0],
            "voxel_offset": offset,
            "point_features": point_features[0],
            "grid": jnp.moveaxis(jnp.concatenate([grid, occupancy[..., None]], axis=-1), -1, 1),
            "volume": jnp.moveaxis(scene.volume, -1, 1),
            "ray_direction": rays.directions,
            "near": near[..., None],
            "far": far[..., None],
            "direction_encoding": encoding.reshape(1, 32, 32, -1)[:, :, 0],
            "coarse_t": coarse,
            "coarse_lookup_row0": voxels.trilinear(scene.volume, jnp.clip(positions, -1, 1))[:, :32],  # the twin clamps
            "coarse_density": density,
            "coarse_rgb_row0": rgb[:, :32],
            "coarse_weights": weights,
            "fine_t": sampling.importance(None, edges, weights, counts.num_fine, counts.padding),
            "features": as_picture(features),
            "rgb": as_picture(rendering.image_lr),
            "acc": as_picture(acc),
            "depth": as_picture(depth - (1 - acc) * far),  # ours adds the light that nothing stops, at `far`
            "image": jnp.moveaxis(rendering.image[:, 0], -1, 1),
        }

    return run(VARIABLES, BATCH.cloud, BATCH.camera)


STAGES = (
    *("voxel_offset", "point_features", "grid", "volume", "ray_direction", "near", "far", "direction_encoding"),
    *("coarse_t", "coarse_lookup_row0", "coarse_density", "coarse_rgb_row0", "coarse_weights", "fine_t"),
    *("features", "rgb", "acc", "depth", "image"),
)


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_of_the_generator_is_the_twins(stages, name):
    agree(stages[name], ARRAYS[f"eval/{name}"].reshape(stages[name].shape))


def test_points_lie_in_the_same_voxels(stages):
    np.testing.assert_array_equal(stages["voxel_index"], ARRAYS["eval/voxel_index"])


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
    norms, stored = (
        {name.removeprefix(begin): x for name, x in ARRAYS.items() if name.startswith(begin)}
        for begin in ("train/grad_norm/gen.", "train/grad/gen.")
    )
    ours = twin_named(trained[3])
    assert set(ours) == set(norms)
    for name, norm in norms.items():
        agree(np.linalg.norm(ours[name]), norm)
    for name, gradient in stored.items():
        agree(ours[name], gradient)


def twin_named(tree):
    """Gradients under the twin's names and in its layout."""

    def conv(x):
        return np.moveaxis(np.asarray(x), (-1, -2), (0, 1))

    points, unet, upsampler = tree["encoder"]["pointnet"], tree["encoder"]["unet"], tree["upsampler"]
    named = {"points.out.weight": points["out"]["kernel"].T, "points.out.bias": points["out"]["bias"]}
    for i in range(3):
        named[f"points.linears.{i}.weight"] = points[f"hidden_{i}"]["kernel"].T
        named |= {
            f"points.norms.{i}.weight": points[f"norm_{i}"]["scale"],
            f"points.norms.{i}.bias": points[f"norm_{i}"]["bias"],
        }
    for name, block in unet.items():
        prefix = "unet." + name.replace("_", ".")
        named |= {f"{prefix}.conv.weight": conv(block["kernel"])}
        named |= {f"{prefix}.norm.weight": block["norm"]["scale"], f"{prefix}.norm.bias": block["norm"]["bias"]}
    for i in range(4):
        named |= {
            f"upsampler.conv{i}.weight": conv(upsampler[f"kernel_{i}"]),
            f"upsampler.conv{i}.bias": upsampler[f"bias_{i}"],
        }
    return named | twin_named_field(tree["field"])


def twin_named_field(field):
    """Ours keeps density and RGB in one matrix, and the rows of hidden layer and direction in two."""
    head, bias = field["head"]["kernel"], field["head"]["bias"]
    hidden = np.concatenate([head[:, 1:], field["features"]["kernel"]], axis=1)
    return {
        "renderer.field.hidden.weight": field["hidden"]["kernel"].T,
        "renderer.field.hidden.bias": field["hidden"]["bias"],
        "renderer.field.density.weight": head[:, :1].T,
        "renderer.field.density.bias": bias[:1],
        "renderer.field.feature.weight": np.concatenate([hidden, field["direction"]["kernel"]]).T,
        "renderer.field.feature.bias": np.concatenate([bias[1:], field["feature_bias"]]),
    }


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
    for parameter, norm in stored.items():
        agree(np.linalg.norm(parameter_of(discriminated[name][1], parameter)), norm)


def parameter_of(tree, name):
    kind, i, what = name.split(".")
    if kind == "convs":
        return tree[f"{'kernel' if what == 'weight' else 'bias'}_{i}"]
    return tree[f"norm_{i}"]["scale" if what == "weight" else "bias"]
