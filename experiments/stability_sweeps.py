"""Which kernel is swept along which axis, and how it is judged.

The harness rounds the inputs to float32 and runs the kernel on them in float32 and in float64, so what is measured is
the kernel's rounding, never that of its inputs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from experiments import stability_kernels as k
from experiments import stability_networks as networks
from spnr_jax.kernels import compositing, losses, metrics, voxels


@dataclass(frozen=True)
class Axis:
    """Something that grows from value to value; the domain is grown from the value `usual`."""

    name: str
    values: tuple[float, ...]
    usual: float
    inputs: Callable[[np.random.Generator, Any], tuple]  # the kernel's arrays at a value
    options: Callable[[Any], dict[str, Any]] = lambda value: {}  # the kernel's other arguments


@dataclass(frozen=True)
class Kernel:
    """A function of arrays (and options) to an array or a tuple of arrays, in the format of its arrays."""

    name: str
    function: Callable
    axes: tuple[Axis, ...]
    twin: Callable | None = None  # the value in float64 NumPy, with which the float64 run has to agree
    score: Callable = lambda arguments, outputs: outputs  # what of the outputs is compared
    floors: tuple[float, ...] = ()  # smallest scale that each output's error is relative to (default 0)
    budget: float = 1e-5
    judged: tuple[str, ...] = ("value_max", "gradient_max")  # errors that have to keep it


def decades(low: int, high: int, step: int = 1) -> tuple[float, ...]:
    """Powers of ten."""
    return tuple(float(f"1e{i}") for i in range(low, high + 1, step))


SIZES = decades(-40, 36, 4)
COUNTS = (1, 8, 64, 512, 4096, 32768, 100_000)
RESOLUTIONS = (2, 4, 8, 16, 32, 64, 128)
DIFFERENCES = (0.0, *decades(-12, 20))


def norm(name: str, function: Callable, shape: tuple[int, ...], axis: int | tuple[int, ...], *more: Axis) -> Kernel:
    """A normalisation of features with the given spread and mean."""
    axes = (
        Axis("spread of the features", decades(-36, 36, 3), 1, lambda rng, v: (v * rng.normal(size=shape),)),
        Axis("mean over spread", decades(0, 8), 1, lambda rng, v: (v + rng.normal(size=shape),)),
    )
    return Kernel(name, function, (*axes, *more), partial(networks.norm_twin, axis=axis))


def network(name: str, function: Callable, shape: tuple[int, ...]) -> tuple[Kernel, Kernel]:
    """A network in float32, and with its convolutions in bfloat16, against itself in float64."""
    axes = (Axis("size of the inputs", decades(-6, 6, 2), 1, lambda rng, v: (v * rng.normal(size=shape),)),)
    return (
        Kernel(f"{name}, float32", partial(function, bf16=False), axes),
        Kernel(f"{name}, bfloat16", partial(function, bf16=True), axes, budget=1e-3, judged=("value_rms",)),
    )


RAYS = (
    Kernel(
        "camera_rays",
        k.view_rays,
        (Axis("field of view, radians", (*decades(-20, -1), 1.5, 3.0, 3.1, 3.14, 3.1415), 0.7, k.view),),
        k.view_rays_twin,
    ),
    Kernel(
        "intersect_box",
        k.box,
        (
            Axis("distance of the camera", (1.0, 2.0, *decades(1, 6)), 1.0, k.box_at_distance),
            Axis("direction component", decades(-40, -2, 2), 0.1, k.box_with_thin_component),
        ),
        k.box_twin,
    ),
    Kernel(
        "stratified",
        k.stratified,
        (
            Axis("size of near and far", SIZES, 1, k.near_and_far),
            Axis("number of samples", COUNTS, 64, lambda rng, n: k.near_and_far(rng), lambda n: {"num_samples": n}),
        ),
        k.stratified_twin,
    ),
    Kernel(
        "importance",
        k.importance,
        (
            Axis("size of all weights", SIZES, 1, lambda rng, v: k.step_function(rng, 62, v)),
            Axis("weight of the only hit", SIZES, 1, k.one_hit),
            Axis("number of bins", COUNTS, 64, k.step_function),
        ),
        score=k.share_below,
    ),
)

LIGHT = (
    Kernel(
        "volume_weights",
        compositing.volume_weights,
        (
            Axis("optical depth of a ray", SIZES, 1, lambda rng, v: k.layers(rng, 128, v)),
            Axis("number of samples", COUNTS, 64, k.layers),
        ),
        k.weights_twin,
        floors=(0.0, 1.0),
    ),
    Kernel(  # why sampling and compositing are float32 whatever `precision` says
        "volume_weights if in bfloat16",
        k.weights_bf16,
        (Axis("number of samples", COUNTS[:5], 64, k.layers),),
        floors=(0.0, 1.0),
        budget=1e-3,
    ),
    Kernel(
        "composite",
        k.composite,
        (
            Axis("size of the colours", SIZES, 1, lambda rng, v: k.colours(rng, 128, v)),
            Axis("number of samples", COUNTS, 64, k.colours),
        ),
        k.composite_twin,
        floors=(1.0,),
    ),
    Kernel(
        "expected_distance",
        compositing.expected_distance,
        (
            Axis("size of the distances", SIZES, 1, lambda rng, v: k.along(rng, 128, v)),
            Axis("number of samples", COUNTS, 64, k.along),
        ),
        k.depth_twin,
    ),
)

VOXELS = (
    Kernel(
        "scatter_mean",
        k.scatter,
        (
            Axis("size of the features", SIZES, 1, lambda rng, v: k.points(rng, 500, 4, v)),
            Axis("points in one voxel", (*COUNTS, 10**6), 64, lambda rng, n: k.points(rng, n, 1)),
            Axis("voxels along an axis", RESOLUTIONS, 32, lambda rng, d: k.points(rng, 4096, d)),
        ),
        k.scatter_twin,
    ),
    Kernel(
        "trilinear",
        voxels.trilinear,
        (
            Axis("size of the features", SIZES, 1, lambda rng, v: k.lookup(rng, 8, v)),
            Axis("voxels along an axis", RESOLUTIONS, 32, k.lookup),
        ),
        k.trilinear_twin,
    ),
)

NORMS = (
    norm(
        "BatchNorm",
        networks.batch_norm,
        (1000, 8),
        0,
        Axis("number of points", (2, 4, *COUNTS[1:]), 512, lambda rng, n: (rng.normal(size=(n, 4)),)),
    ),
    norm("GroupNorm", networks.group_norm, (8, 8, 8, 4), (0, 1, 2, 3)),
)

NETWORKS = (
    *network("3D U-Net", networks.unet, (1, 200, 5)),
    *network("upsampler", networks.upsampler, (1, 12, 12, 6)),
    *network("discriminator", networks.discriminator, (1, 32, 32, 3)),
)

LOGITS = (Axis("size of the logits", decades(-8, 36, 4), 1, lambda rng, v: tuple(v * rng.normal(size=(2, 64)))),)

LOSSES = (
    Kernel("l1", losses.l1, (Axis("difference", SIZES, 1, k.apart),), k.l1_twin),
    Kernel("adversarial, both", k.adversarial, LOGITS, k.adversarial_twin),
    Kernel("r1", k.r1, (Axis("size of the gradient", decades(-40, 40, 4), 1, k.penalised),), k.r1_twin),
)

METRICS = (
    Kernel("psnr", metrics.psnr, (Axis("difference", DIFFERENCES, 0.1, k.off_grey),), k.psnr_twin, floors=(1.0,)),
    Kernel(
        "conditional_psnr",
        k.conditional_psnr,
        (Axis("difference", DIFFERENCES, 0.1, k.off_grey),),
        k.conditional_psnr_twin,
        floors=(1.0,),
    ),
    Kernel(
        "ssim",
        metrics.ssim,
        (
            Axis("contrast", decades(-8, 8), 0.1, k.textures),
            Axis("brightness at contrast 0.01", decades(-4, 2), 0.1, lambda rng, v: k.textures(rng, 0.01, v)),
        ),
        k.ssim_twin,
        floors=(1.0,),
    ),
)

RENDER = (
    Kernel(
        "whole render",
        networks.render,
        (
            Axis("density", decades(-30, 30, 3), 1, networks.scene),
            Axis("distance of the camera", (1.0, *decades(1, 6)), 3, lambda rng, v: networks.scene(rng, distance=v)),
            Axis(
                "coarse and fine samples each",
                (1, 4, 16, 64, 256),
                16,
                lambda rng, n: networks.scene(rng),
                lambda n: {"samples": n},
            ),
        ),
        floors=(1.0, 1.0, 1.0),
    ),
)

FIGURES: dict[str, tuple[Kernel, ...]] = {
    "rays": RAYS,
    "light": LIGHT,
    "voxels": VOXELS,
    "norms": NORMS,
    "networks": NETWORKS,
    "losses": LOSSES,
    "metrics": METRICS,
    "render": RENDER,
}
