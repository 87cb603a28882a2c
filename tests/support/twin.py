"""The parity fixture: weights, inputs and what is compared of a PyTorch twin in float64, under the twin's names.

"meta" is JSON with its config, "param/gen.*" and "param/disc.*" are its state_dicts, "in/*" is its batch.
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed import bench
from spnr_jax.config import TrainConfig

Arrays = Mapping[str, np.ndarray]
FIXTURE = Path(__file__).with_name("twin_fixture.npz")


def load():
    """All arrays of the fixture by name, the JSON string under "meta"."""
    with np.load(FIXTURE, allow_pickle=False) as data:
        return dict(data.items())


def config(arrays: Arrays) -> TrainConfig:
    """The sizes that are timed as `tiny`, with the discriminator and R1 of the fixture."""
    theirs, ours = json.loads(str(arrays["meta"]))["config"], bench.our_config("tiny")
    loss = dataclasses.replace(
        ours.loss,
        r1_gamma=theirs["r1_gamma"],
        r1_interval=theirs["r1_every"],
        discriminator_width=theirs["disc_width"],
    )
    return dataclasses.replace(ours, loss=loss)


def inputs(arrays: Arrays) -> Arrays:
    """The arrays of "in/*"."""
    return {name.removeprefix("in/"): x for name, x in arrays.items() if name.startswith("in/")}


def named(arrays: Arrays, prefix: str) -> dict[str, jax.Array]:
    """The arrays whose names begin so, under the rest of their names."""
    return {k.removeprefix(prefix): jnp.asarray(v) for k, v in arrays.items() if k.startswith(prefix)}


def _conv(x):
    return jnp.moveaxis(x, (0, 1), (-1, -2))


def generator(get: Mapping[str, jax.Array]) -> tuple[dict, dict]:
    """(params, batch_stats) of the generator; its gradients by the given arrays have the twin's names."""
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


def discriminator(get: Mapping[str, jax.Array]) -> dict:
    """Parameters of the discriminator, likewise."""
    params = {f"kernel_{i}": _conv(get[f"convs.{i}.weight"]) for i in range(5)}
    params |= {f"bias_{i}": get[f"convs.{i}.bias"] for i in (0, 4)}
    norms = {f"norm_{i}": {"scale": get[f"norms.{i}.weight"], "bias": get[f"norms.{i}.bias"]} for i in (1, 2, 3)}
    return params | norms
