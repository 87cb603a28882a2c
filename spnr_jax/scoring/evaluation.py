"""Scores of methods on a split of a data set: a network beside the trivial renderers that every table shows.

A method is a function that draws the views of an object from its points (`Draw`); all of them see the same points and
cameras, and are scored by the same metrics.

    white      an empty picture
    splat      every point a disc of `radius` that faces the camera (parallel to the image plane)
    nearest    every point a ball of `radius`; where a ray first meets their union, the nearest point gives the colour

Both point renderers take the base colour as the colour (no light), linear -> sRGB, on white, without antialiasing.
Their radius, in world units, is chosen on training objects: the multiple of the point spacing with the best PSNR.  The
arithmetic is dense, every ray against every point, a block of rays at a time.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from spnr_jax.config import NetworkConfig, TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.kernels import metrics
from spnr_jax.kernels.cameras import camera_rays, resize
from spnr_jax.kernels.imaging import linear_to_srgb
from spnr_jax.kernels.records import Camera, PointCloud
from spnr_jax.method.model import render_views
from spnr_jax.methods import method_of
from spnr_jax.scoring.picture_scores import Scores, differences, flip, lpips, metric_settings, summarise
from spnr_jax.training.checkpoint import read_light
from spnr_jax.training.gbuffers import average_squares
from spnr_jax.training.weights import Trained, read_trained

RADIUS_FACTORS = (0.5, 0.75, 1.0, 1.5, 2.0)
RADIUS_OBJECTS, RADIUS_PIXELS = 8, 128  # training objects, and size of their pictures, on which one of them is chosen
TRIVIAL = ("white", "splat", "nearest")  # the trivial renderers above
BLOCK = 2**19  # pairs of a ray (or point) and a point in memory at once, per view: 6 MB


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """Renderings of one object by a method: image (views, height, width, 3), opacity and depth (views, h, w).

    Opacity and depth may be smaller than the image; the trivial renderers have no depth.
    """

    image: np.ndarray | Array
    acc: np.ndarray | Array
    depth: np.ndarray | Array | None = None


Draw = Callable[[data_sets.ObjectData], Pictures]


@dataclass(frozen=True, kw_only=True)
class ObjectResult:
    """The references (views, height, width, 3) of one object, and every method's pictures and scores."""

    name: str
    reference: np.ndarray
    pictures: dict[str, Pictures]
    scores: dict[str, Scores]


@jax.jit
def _score(
    image: Float[Array, "views height width 3"],
    acc: Float[Array, "views height width"],
    reference: Array,
    alpha: Array,
    mask: Array,
) -> dict[str, Array]:
    """Metrics of one object's views that are computed by JAX."""
    return {
        "psnr": metrics.psnr(image, reference),
        "ssim": metrics.ssim(image, reference),
        "cpsnr": metrics.conditional_psnr(image, reference, mask),
        "iou": metrics.opacity_iou(acc, alpha),
    }


def choose_radius(dataset: data_sets.Dataset, config: TrainConfig, method: str) -> float:
    """The radius factor with the highest PSNR over a few training objects, at RADIUS_PIXELS or nearly."""
    names = dataset.splits["train"][:RADIUS_OBJECTS]
    items = [shrink(_thin(data_sets.read_object(dataset, name), config)) for name in names]
    if not items:
        raise UserError(f"{dataset.folder}: no training objects to choose the radius of `{method}` on; generate some")

    def mean_psnr(factor: float) -> float:
        show = make_trivial(method, factor)
        pairs = [(jnp.asarray(show(item).image), jnp.asarray(data_sets.on_white(item.images))) for item in items]
        return float(np.mean([metrics.psnr(image, reference) for image, reference in pairs]))

    return max(RADIUS_FACTORS, key=mean_psnr)


def shrink(item: data_sets.ObjectData) -> data_sets.ObjectData:
    """The object with pictures of at most RADIUS_PIXELS along a side, if means of whole pixels make such."""
    height, width = item.images.shape[1:3]
    side = next(n for n in range(max(height // RADIUS_PIXELS, 1), 0, -1) if not (height % n or width % n))
    if side == 1:
        return item
    images = np.stack([average_squares(image, side) for image in item.images])
    return dataclasses.replace(item, images=images, camera=resize(item.camera, height // side, width // side))


def _thin(item: data_sets.ObjectData, config: TrainConfig) -> data_sets.ObjectData:
    """The object with the points that methods get."""
    return dataclasses.replace(item, cloud=data_sets.first_points(item, config.test_points))


def check_known_light(config: NetworkConfig, dataset: data_sets.Dataset) -> None:
    """ValueError if the network is drawn in a light, and the data set's is not known."""
    if method_of(config).takes_light:
        dataset.check_lit_by_room()


def make_method(variables: dict, config: TrainConfig) -> Draw:
    """The method of a trained network; normals are removed from the clouds, because other methods get none."""

    def show(item: data_sets.ObjectData) -> Pictures:
        cloud = dataclasses.replace(item.cloud, normals=None)
        rendering = render_views(variables, config.model, cloud, item.camera)
        return Pictures(image=rendering.image, acc=rendering.acc, depth=rendering.depth)

    return show


def make_trivial(name: str, factor: float = 1.0) -> Draw:
    """The method of a trivial renderer; the radius of its points is `factor` times their spacing."""

    def show(item: data_sets.ObjectData) -> Pictures:
        if name == "white":
            white = jnp.ones((*item.images.shape[:-1], 3))
            return Pictures(image=white, acc=jnp.zeros(white.shape[:-1]))
        radius = jnp.float32(factor * measure_nearest_distance(item.cloud))
        image, acc = _draw_trivial(item.cloud, item.camera, radius, method=name)
        return Pictures(image=image, acc=acc)

    return show


@partial(jax.jit, static_argnames="method")
def _draw_trivial(cloud: PointCloud, camera: Camera, radius: Float[Array, ""], *, method: str) -> tuple[Array, Array]:
    draw = {"splat": render_splat, "nearest": render_nearest}[method]
    return jax.vmap(lambda view: draw(cloud, view, radius))(camera)


def evaluate_object(methods: dict[str, Draw], config: TrainConfig, item: data_sets.ObjectData) -> ObjectResult:
    """Pictures and scores of one object."""
    check_scorable(item, config)
    item, pictures, scores = _thin(item, config), {}, {}
    for method, show in methods.items():
        pictures[method] = to_numpy(show(item))
        scores[method] = _score_pictures(item, pictures[method])
    return ObjectResult(name=item.name, reference=data_sets.on_white(item.images), pictures=pictures, scores=scores)


def check_scorable(item: data_sets.ObjectData, config: TrainConfig) -> None:
    """ValueError for pictures of another size than the network's, or with a light each."""
    if not config.model.any_size:
        data_sets.check_resolution(item, config)
    if item.lights is not None:
        raise UserError(
            f"object {item.name}: each view has its own light; `experiments.studies.relighting` scores those"
        )


def _score_pictures(item: data_sets.ObjectData, pictures: Pictures) -> Scores:
    """All metrics of pictures of an object's views, LPIPS where it can be measured; the opacity is interpolated."""
    alpha, mask = item.images[..., 3] / np.float32(255), item.conditions[..., 3] > 0
    image, reference = np.asarray(pictures.image), data_sets.on_white(item.images)
    acc = jax.image.resize(jnp.asarray(pictures.acc), alpha.shape, "bilinear")
    scores = jax.device_get(_score(image, acc, reference, alpha, mask)) | {"flip": flip(image, reference)}
    distance = lpips(image, reference)
    return scores if distance is None else scores | {"lpips": distance}


def to_numpy(pictures: Pictures) -> Pictures:
    """The pictures as NumPy arrays, the image in [0, 1]."""
    depth = None if pictures.depth is None else np.asarray(pictures.depth)
    return Pictures(image=np.clip(np.asarray(pictures.image), 0, 1), acc=np.asarray(pictures.acc), depth=depth)


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The output of `spnr evaluate`: content of metrics.json, and results of the objects in the gallery."""

    config: TrainConfig
    summary: dict
    gallery: list[ObjectResult]


def pick_evenly(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    """`count` of the names, evenly spaced from the first to the last."""
    return tuple(names[round(i)] for i in np.linspace(0, len(names) - 1, min(count, len(names))))


def median_view(psnr: np.ndarray) -> int:
    """The view with the median PSNR, as the most typical one."""
    return int(np.argsort(psnr)[len(psnr) // 2])


def score_methods(
    methods: dict[str, Draw],
    config: TrainConfig,
    dataset: data_sets.Dataset,
    names: tuple[str, ...],
    gallery_objects: int,
    say: Callable[[str], None],
) -> tuple[dict[str, dict[str, Scores]], list[ObjectResult]]:
    """Scores of every object by name, and the results of a few objects for the gallery."""
    scores: dict[str, dict[str, Scores]] = {}
    gallery = []
    shown = pick_evenly(names, gallery_objects)
    for i, name in enumerate(names):
        result = evaluate_object(methods, config, data_sets.read_object(dataset, name))
        scores[name] = result.scores
        if name in shown:
            gallery.append(result)
        if (i + 1) % 8 == 0 or i + 1 == len(names):
            say(f"evaluated {i + 1} of {len(names)} objects")
    return scores, gallery


def evaluate(
    run: Path,
    dataset: data_sets.Dataset,
    split: str = "test",
    gallery_objects: int = 16,
    say: Callable[[str], None] = print,
) -> Evaluation:
    """Scores of a run's newest checkpoint on a split, under the name of its method."""
    trained, light = read_trained(run, say), read_light(Path(run))
    if light not in (None, dataset.light) and not method_of(trained.config.model).takes_light:
        say(f"{run} was trained in another light ({light}) than that of {dataset.folder} ({dataset.light})")
    return compare({trained.config.model.method: trained}, dataset, split, gallery_objects, say)


def compare(
    trained: dict[str, Trained],
    dataset: data_sets.Dataset,
    split: str = "test",
    gallery_objects: int = 16,
    say: Callable[[str], None] = print,
) -> Evaluation:
    """Scores of networks on a split, all with the same points; differences are the first minus each other."""
    first = next(iter(trained))
    config = trained[first].config
    names = dataset.splits[split]
    if not names:
        others = " or ".join(f"--split {name}" for name, ids in dataset.splits.items() if ids) or "another split"
        more = {"test": " with --test-objects N", "val": " with --val-fraction SHARE"}.get(split, "")
        raise UserError(
            f"{dataset.folder}: the {split} split is empty; score {others}, or generate the data set anew{more}"
        )
    for one in trained.values():
        check_known_light(one.config.model, dataset)
    check_scorable(item := data_sets.read_object(dataset, names[0]), config)
    say("choosing the radius of the points for the trivial methods")
    factors = {method: choose_radius(dataset, config, method) for method in ("splat", "nearest")}
    methods = {name: make_method(one.variables, one.config) for name, one in trained.items()}
    methods |= {name: make_trivial(name, factors.get(name, 1.0)) for name in TRIVIAL}
    scores, gallery = score_methods(methods, config, dataset, names, gallery_objects, say)
    summary = {
        "methods": summarise(list(scores.values())),
        f"{first}_minus": differences(list(scores.values()), first),
        "preset": config.preset,
        "steps": trained[first].steps,
        "seed": config.seed,
        "hardware": runtime.describe_hardware(),
        "settings": {
            "split": split,
            "networks": {name: {"preset": one.config.preset, "steps": one.steps} for name, one in trained.items()},
            "points": len(_thin(item, config).cloud.mask),
            "radius factors": factors,
            "metrics": metric_settings(),
        },
    }
    return Evaluation(config=config, summary=summary, gallery=gallery)


# --- the trivial renderers --------------------------------------------------------------------------------------------


def render_splat(
    cloud: PointCloud, camera: Camera, radius: Float[Array, ""] | float
) -> tuple[Float[Array, "height width 3"], Float[Array, "height width"]]:
    """sRGB image and opacity (0 or 1) of discs around the points; the disc nearest in camera depth wins."""
    forward = -camera.cam_to_world[:, 2]
    offset = (cloud.positions - camera.cam_to_world[None, :, 3]).T
    depth = jnp.einsum("in,i->n", offset, forward, precision="highest")
    present = cloud.mask & (depth > 0)

    def order(direction):  # the ray crosses the plane of a disc at `distance`
        distance = depth / jnp.dot(direction, forward, precision="highest")
        beside = distance[None] * direction[:, None] - offset
        return jnp.where(present & (jnp.sum(beside**2, axis=0) <= radius**2), depth, jnp.inf)

    return _shade_first(cloud, camera, order)


def render_nearest(
    cloud: PointCloud, camera: Camera, radius: Float[Array, ""] | float
) -> tuple[Float[Array, "height width 3"], Float[Array, "height width"]]:
    """sRGB image and opacity (0 or 1) of the union of balls around the points, coloured by the nearest point.

    The ball that a ray enters first belongs to the nearest point of the intersection: the ball of a nearer point would
    have been entered before.  For an eye inside balls the intersection is the eye itself.
    """
    offset = (cloud.positions - camera.cam_to_world[None, :, 3]).T
    to_surface = jnp.sqrt(jnp.sum(offset**2, axis=0)) - radius

    def order(direction):
        along = jnp.einsum("in,i->n", offset, direction, precision="highest")
        beside = along[None] * direction[:, None] - offset
        half_chord_squared = radius**2 - jnp.sum(beside**2, axis=0)
        hit = cloud.mask & (half_chord_squared >= 0) & (along > 0)
        entry = jnp.where(hit, along - jnp.sqrt(jnp.maximum(half_chord_squared, 0)), jnp.inf)
        return jnp.where(cloud.mask & (to_surface <= 0), to_surface, entry)

    return _shade_first(cloud, camera, order)


def measure_nearest_distance(cloud: PointCloud) -> float:
    """Median distance of a real point to its nearest other, in world units; 0 for fewer than two points."""
    real = np.asarray(cloud.positions)[np.asarray(cloud.mask)]
    return float(np.median(cKDTree(real).query(real, 2)[0][:, 1])) if len(real) > 1 else 0.0


def _shade_first(cloud, camera, order):
    """Image and opacity; each ray shows the point with the least `order`(direction); infinity is a miss."""
    directions = camera_rays(camera).directions.reshape(-1, 3)

    def first(direction):
        ranks = order(direction)
        index = jnp.argmin(ranks)
        return index, jnp.isfinite(ranks[index])

    index, hit = jax.lax.map(first, directions, batch_size=max(1, BLOCK // cloud.mask.shape[0]))
    color = jnp.where(hit[:, None], linear_to_srgb(cloud.base_color)[index], 1.0)
    size = camera.height, camera.width
    return color.reshape(*size, 3), hit.astype(color.dtype).reshape(size)
