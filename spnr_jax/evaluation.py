"""How good a network is on a split of a data set, beside the trivial renderers that every table shows.

Means are over images; a condition PSNR leaves out images in which no input point is visible and counts the others.
The radius of the point renderers is chosen on training objects: the multiple of the point spacing with the best PSNR.
"""

import os
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax import checkpoint, data, metrics, training
from spnr_jax.baselines import floors
from spnr_jax.config import TrainConfig
from spnr_jax.types import Camera, PointCloud, Rendering

RADIUS_FACTORS = (0.5, 0.75, 1.0, 1.5, 2.0)
METHODS = ("ours", "white", "splat", "nearest")


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores of one method on the views of one object, each (views,); cpsnr is NaN where no point is visible."""

    psnr: np.ndarray
    ssim: np.ndarray
    cpsnr: np.ndarray
    iou: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ObjectResult:
    """Pictures (views, height, width, ...) of every method and their scores on one object."""

    name: str
    reference: np.ndarray
    images: dict[str, np.ndarray]
    depth: np.ndarray
    acc: np.ndarray
    scores: dict[str, Scores]


@jax.jit
def score(
    image: Float[Array, "views h w 3"], acc: Float[Array, "views h w"], reference: Array, alpha: Array, mask: Array
) -> dict[str, Array]:
    """All metrics of one object's views."""
    image = jnp.clip(image, 0, 1)
    return {
        "psnr": metrics.psnr(image, reference),
        "ssim": metrics.ssim(image, reference),
        "cpsnr": metrics.conditional_psnr(image, reference, mask),
        "iou": metrics.opacity_iou(acc, alpha),
    }


@partial(jax.jit, static_argnames="method")
def render_floor(method: str, cloud: PointCloud, camera: Camera, factor: float | Array) -> tuple[Array, Array]:
    """Image and opacity of a trivial renderer for all views of one cloud."""
    if method == "white":
        image = floors.white(camera)
        return image, jnp.zeros(image.shape[:-1])
    radius = factor * floors.spacing(cloud)
    return jax.vmap(lambda view: getattr(floors, method)(cloud, view, radius))(camera)


def test_cloud(item: data.ObjectData, config: TrainConfig) -> PointCloud:
    """The object's first `test_points` points: always the same ones."""
    count = min(config.test_points, len(item.cloud.positions))
    return jax.tree.map(lambda x: x[:count], item.cloud)


def choose_radius(dataset: data.Dataset, config: TrainConfig, method: str, num_objects: int = 8) -> float:
    """The radius factor with the highest PSNR over a few training objects."""
    items = [data.read_object(dataset, name) for name in dataset.splits["train"][:num_objects]]
    if not items:
        raise ValueError(f"{dataset.folder}: no training objects to choose the radius of `{method}` on; generate some")

    def mean_psnr(factor: float) -> float:
        values = []
        for item in items:
            image, _ = render_floor(method, test_cloud(item, config), item.camera, factor)
            values.append(metrics.psnr(image, jnp.asarray(data.on_white(item.images))))
        return float(np.mean(values))

    return max(RADIUS_FACTORS, key=mean_psnr)


def render_views(variables: dict, config: TrainConfig, cloud: PointCloud, camera: Camera) -> Rendering:
    """All views of one object (clouds of data sets are normalised already)."""
    cloud, camera = jax.tree.map(lambda x: jnp.asarray(x)[None], (cloud, camera))
    volume = training.jitted_encode(variables, cloud, config=config.model)
    rendering = training.jitted_render(variables, volume, camera, config=config.model)
    return jax.tree.map(lambda x: x[0], rendering)


def evaluate_objects(
    variables: dict, config: TrainConfig, dataset: data.Dataset, names: tuple[str, ...], factors: dict[str, float]
) -> Iterator[ObjectResult]:
    """Pictures and scores of each object of a data set."""
    for name in names:
        item = data.read_object(dataset, name)
        data.check_resolution(item, config)
        cloud = test_cloud(item, config)
        rendering = render_views(variables, config, cloud, item.camera)
        size = item.images.shape[1:3]
        acc = jax.image.resize(rendering.acc, (len(item.images), *size), "bilinear")
        pictures = {"ours": (rendering.image, acc)}
        pictures |= {m: render_floor(m, cloud, item.camera, factors.get(m, 1.0)) for m in METHODS[1:]}
        alpha, mask = item.images[..., 3] / np.float32(255), item.conditions[..., 3] > 0
        reference = data.on_white(item.images)
        scores = {m: Scores(**jax.device_get(score(*p, reference, alpha, mask))) for m, p in pictures.items()}
        yield ObjectResult(
            name=name,
            reference=reference,
            images={m: np.clip(np.asarray(p[0]), 0, 1) for m, p in pictures.items()},
            depth=np.asarray(rendering.depth),
            acc=np.asarray(rendering.acc),
            scores=scores,
        )


def summarise(results: list[dict[str, Scores]]) -> dict[str, dict[str, float | None]]:
    """Means over all images of each method, with the counts behind them."""
    table = {}
    for method in METHODS:
        stacked = {
            k: np.concatenate([getattr(r[method], k) for r in results]) for k in ("psnr", "ssim", "cpsnr", "iou")
        }
        visible = stacked["cpsnr"][~np.isnan(stacked["cpsnr"])]
        table[method] = {
            "psnr": float(stacked["psnr"].mean()),
            "ssim": float(stacked["ssim"].mean()),
            "cpsnr": float(visible.mean()) if len(visible) else None,
            "iou": float(stacked["iou"].mean()),
            "objects": len(results),
            "views": len(stacked["psnr"]),
            "cpsnr_views": len(visible),
        }
    return table


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What `spnr evaluate` writes: the metrics.json content, and results of the objects for the gallery."""

    config: TrainConfig
    summary: dict
    per_category: dict[str, dict]
    gallery: list[ObjectResult]


def evaluate(
    run: Path, dataset: data.Dataset, split: str = "test", gallery_objects: int = 16, say: Callable[[str], None] = print
) -> Evaluation:
    """Scores of a run's newest checkpoint on a split."""
    config, state = checkpoint.load_run(run, say, data=dataset.folder)
    names = dataset.splits[split]
    if not names:
        raise ValueError(f"{dataset.folder}: the {split} split is empty; choose another one or generate more objects")
    factors = {method: choose_radius(dataset, config, method) for method in ("splat", "nearest")}
    variables = training.averaged_variables(state)
    scores, gallery = {}, []
    shown = {names[round(i)] for i in np.linspace(0, len(names) - 1, min(gallery_objects, len(names)))}
    for i, result in enumerate(evaluate_objects(variables, config, dataset, names, factors)):
        scores[result.name] = result.scores
        if result.name in shown:
            gallery.append(result)
        if (i + 1) % 8 == 0 or i + 1 == len(names):
            say(f"evaluated {i + 1} of {len(names)} objects")
    categories = sorted({category_of(name) for name in names})
    summary = {
        "methods": summarise(list(scores.values())),
        "preset": config.preset,
        "steps": int(state.step),
        "seed": config.seed,
        "hardware": hardware(),
        "settings": {
            "split": split,
            "points": config.test_points,
            "radius factors": factors,
            "metrics": "PSNR (max. 100 dB), SSIM (gaussian, sigma 1.5) on sRGB in [0, 1] over white, mean over images",
        },
    }
    per_category = {c: summarise([s for n, s in scores.items() if category_of(n) == c]) for c in categories}
    return Evaluation(config=config, summary=summary, per_category=per_category, gallery=gallery)


def category_of(name: str) -> str:
    """Class of an object from its name (chair_000012); mesh files are one class."""
    stem, _, number = name.rpartition("_")
    return stem if number.isdigit() and len(number) == 6 else "meshes"


def hardware() -> str:
    """The device that JAX uses, in words."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return f"{jax.device_count()} x {device.device_kind}"
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{len(os.sched_getaffinity(0))} cores of {names[0] if names else platform.machine()}"
