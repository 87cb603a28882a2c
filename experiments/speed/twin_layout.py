"""The names and the layout of the PyTorch twin (weights, sizes, batches) in this project's records.

`arrays` are NumPy arrays by the twin's names: "meta" (JSON with its config), "param/gen.*" and "param/disc.*"
(state_dict), "in/*" (a batch, images channel-first).  The same map serves the parity tests and the benchmark.
"""

import json
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from spnr_jax.config import EncoderConfig, LossConfig, OptimizerConfig, PaperConfig, SamplingConfig, TrainConfig
from spnr_jax.kernels.records import Batch, Camera, PointCloud

Arrays = Mapping[str, np.ndarray]


def train_config(arrays: Arrays) -> TrainConfig:
    """The config with all sizes that "meta" names."""
    c = json.loads(str(arrays["meta"]))["config"]
    encoder = EncoderConfig(
        point_widths=tuple(c["point_widths"]),
        point_features=c["point_features"],
        volume_resolution=c["grid"],
        base_width=c["base"],
        num_stages=c["stages"],
        num_groups=c["groups"],
    )
    model = PaperConfig(
        encoder=encoder,
        field_width=c["field_hidden"],
        num_features=c["features"],
        direction_frequencies=c["dir_freqs"],
        sampling=SamplingConfig(num_coarse=c["coarse"], num_fine=c["fine"], padding=c["pdf_pad"]),
        render_resolution=c["render"],
        resize_resolution=c["render"],
        image_resolution=2 * c["render"],
        upsampler_width=c["up_width"],
    )
    loss = LossConfig(
        l1_weight=c["l1_weight"],
        low_resolution_weight=c["lowres_weight"],
        adversarial_weight=c["adv_weight"],
        r1_gamma=c["r1_gamma"] if c["r1_every"] else 0.0,  # the twin's 0 is "never"
        r1_interval=max(c["r1_every"], 1),
        discriminator_width=c["disc_width"],
    )
    optimizer = OptimizerConfig(lr_generator=c["lr_g"], lr_discriminator=c["lr_d"])
    points = c["points"]
    return TrainConfig(
        model=model, loss=loss, optimizer=optimizer, batch_objects=1, min_points=points, max_points=points
    )


def batch(arrays: Arrays) -> Batch:
    """The batch of "in/*": one view of each object, every point real."""
    positions, materials = arrays["in/pos"], arrays["in/mat"]
    cloud = PointCloud(
        positions=positions,
        base_color=materials[..., :3],
        roughness=materials[..., 3],
        metallic=materials[..., 4],
        mask=np.ones(positions.shape[:2], bool),
    )
    images = {k: np.moveaxis(arrays[f"in/{k}"], 1, -1)[:, None] for k in ("target", "cond", "mask")}
    size = images["target"].shape[-2]
    focal = arrays["in/focal"][:, None] * size / 2
    intrinsics = np.zeros((*focal.shape, 3, 3), np.float32)
    intrinsics[..., 0, 0] = intrinsics[..., 1, 1] = focal
    intrinsics[..., 0, 2] = intrinsics[..., 1, 2] = size / 2
    intrinsics[..., 2, 2] = 1
    camera = Camera(cam_to_world=arrays["in/c2w"][:, None], intrinsics=intrinsics, height=size, width=size)
    return Batch(
        cloud=cloud,
        camera=camera,
        image=images["target"],
        alpha=np.ones_like(images["mask"][..., 0]),  # the twin has no loss of opacity
        condition=images["cond"],
        condition_mask=images["mask"][..., 0] > 0.5,
    )


def _conv(x):
    return np.moveaxis(x, (0, 1), (-1, -2))


def generator(arrays: Arrays, prefix: str = "param/gen.") -> tuple[dict, dict]:
    """(params, batch_stats) of the generator; with prefix "train/grad/gen." its gradients, where they are stored."""
    get = {k.removeprefix(prefix): jnp.asarray(v) for k, v in arrays.items() if k.startswith(prefix)}
    pointnet = {"out": {"kernel": get["points.out.weight"].T, "bias": get["points.out.bias"]}}
    stats = {}
    for i in range(3):
        pointnet[f"hidden_{i}"] = {"kernel": get[f"points.linears.{i}.weight"].T}
        pointnet[f"norm_{i}"] = {"scale": get[f"points.norms.{i}.weight"], "bias": get[f"points.norms.{i}.bias"]}
        stats[f"norm_{i}"] = {
            "mean": get[f"points.norms.{i}.running_mean"],
            "variance": get[f"points.norms.{i}.running_var"],
        }
    unet = {}
    for name in [k.removesuffix(".conv.weight") for k in get if k.startswith("unet.") and k.endswith("conv.weight")]:
        unet[name.removeprefix("unet.").replace(".", "_")] = {
            "kernel": _conv(get[name + ".conv.weight"]),
            "norm": {"scale": get[name + ".norm.weight"], "bias": get[name + ".norm.bias"]},
        }
    density, feature = "renderer.field.density.", "renderer.field.feature."
    hidden = get[density + "weight"].shape[1]
    weight, bias = get[feature + "weight"].T, get[feature + "bias"]
    field = {
        "hidden": {"kernel": get["renderer.field.hidden.weight"].T, "bias": get["renderer.field.hidden.bias"]},
        "head": {
            "kernel": jnp.concatenate([get[density + "weight"].T, weight[:hidden, :3]], axis=1),
            "bias": jnp.concatenate([get[density + "bias"], bias[:3]]),
        },
        "direction": {"kernel": weight[hidden:]},
        "features": {"kernel": weight[:hidden, 3:]},
        "feature_bias": bias[3:],
    }
    upsampler = {f"kernel_{i}": _conv(get[f"upsampler.conv{i}.weight"]) for i in range(4)}
    upsampler |= {f"bias_{i}": get[f"upsampler.conv{i}.bias"] for i in range(4)}
    params = {"encoder": {"pointnet": pointnet, "unet": unet}, "field": field, "upsampler": upsampler}
    return params, {"encoder": {"pointnet": stats}}


def discriminator(arrays: Arrays, prefix: str = "param/disc.") -> dict:
    """Parameters of the discriminator."""
    get = {k.removeprefix(prefix): jnp.asarray(v) for k, v in arrays.items() if k.startswith(prefix)}
    params = {f"kernel_{i}": _conv(get[f"convs.{i}.weight"]) for i in range(5)}
    params |= {f"bias_{i}": get[f"convs.{i}.bias"] for i in (0, 4)}
    norms = {f"norm_{i}": {"scale": get[f"norms.{i}.weight"], "bias": get[f"norms.{i}.bias"]} for i in (1, 2, 3)}
    return params | norms
