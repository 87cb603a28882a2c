"""Every method on the same unseen objects: scores, the seconds that its pictures took, and one view to look at.

Here a method shows an object of the data set, because pictures of Poisson surfaces are kept under its name.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from spnr_jax.config import TrainConfig
from spnr_jax.formats import data_sets
from spnr_jax.kernels.metrics import psnr
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.report import duration
from spnr_jax.scoring.summary import Scores, summarise

ObjectMethod = Callable[[data_sets.ObjectData], evaluation.Pictures]
PROGRESS_LINES = 20
OPAQUE = 0.5  # opacity of the reference from which a pixel lies inside the silhouette


@dataclass(frozen=True, kw_only=True)
class Shown:
    """One view of one object: reference and the picture of each method (height, width, 3), with its PSNR."""

    name: str
    view: int
    reference: np.ndarray
    images: dict[str, np.ndarray]
    psnr: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class Scored:
    """Scores by object and method, the objects to look at, and each method's seconds per view by object."""

    scores: dict[str, dict[str, Scores]]
    shown: list[Shown]
    seconds: dict[str, list[float]]


def of_cloud(method: evaluation.Method, config: TrainConfig) -> ObjectMethod:
    """The method of an object that shows its first points to its cameras."""
    return lambda item: method(data_sets.test_cloud(item, config), item.camera)


def score_objects(
    methods: dict[str, ObjectMethod],
    config: TrainConfig,
    dataset: data_sets.Dataset,
    names: tuple[str, ...],
    num_shown: int,
    more: Callable[[data_sets.ObjectData, evaluation.Pictures], Scores] | None = None,
) -> Scored:
    """All methods on these objects, with a line now and then; points and image size are the config's.

    `more` scores a method's pictures of an object in other ways, too.
    """
    seconds: dict[str, list[float]] = {method: [] for method in methods}
    scores, shown, to_show, start = {}, [], evaluation.spread(names, num_shown), time.monotonic()
    for number, name in enumerate(names, start=1):
        item = data_sets.read_object(dataset, name)
        shows = {method: timed(show, item, seconds[method]) for method, show in methods.items()}
        result = evaluation.evaluate_object(shows, config, item)
        if "npbg" in result.scores:
            del result.scores["npbg"]["iou"]  # it predicts colours alone
        if more:
            for method, pictures in result.pictures.items():
                result.scores[method] |= more(item, pictures)
        scores[name] = result.scores
        if name in to_show:
            shown.append(shown_view(result))
        if number % max(1, len(names) // PROGRESS_LINES) == 0 or number == len(names):
            left = duration((time.monotonic() - start) / number * (len(names) - number))
            print(f"scored {number} of {len(names)} objects, about {left} left", flush=True)
    return Scored(scores=scores, shown=shown, seconds=seconds)


def timed(show: ObjectMethod, item: data_sets.ObjectData, seconds: list[float]) -> evaluation.Method:
    """The method bound to an object, noting the seconds per view until the pictures lie on the host."""

    def measured(*_: object) -> evaluation.Pictures:
        start = time.monotonic()
        pictures = evaluation.on_host(show(item))
        seconds.append((time.monotonic() - start) / len(pictures.image))
        return pictures

    return measured


def shown_view(result: evaluation.ObjectResult) -> Shown:
    """The view whose PSNR is the median of the first method's."""
    view = evaluation.median_view(next(iter(result.scores.values()))["psnr"])
    return Shown(
        name=result.name,
        view=view,
        reference=result.reference[view],
        images={method: np.asarray(pictures.image[view]) for method, pictures in result.pictures.items()},
        psnr={method: float(scores["psnr"][view]) for method, scores in result.scores.items()},
    )


def by_category(scores: dict[str, dict[str, Scores]]) -> dict[str, dict]:
    """The summary of each class of objects, if there are several."""
    classes = evaluation.classes_of(scores)
    return {c: summarise([scores[name] for name in names]) for c, names in classes.items()} if len(classes) > 1 else {}


def silhouette(item: data_sets.ObjectData) -> np.ndarray:
    """Pixels (views, height, width) that the object covers by more than half."""
    return item.images[..., 3] > 255 * OPAQUE


def mean_colors(item: data_sets.ObjectData, image: np.ndarray) -> np.ndarray:
    """Mean colour (views, 3) of pictures of an object inside the silhouette."""
    inside = silhouette(item)[..., None].astype(np.float64)
    return (np.asarray(image, np.float64) * inside).sum(axis=(1, 2)) / np.maximum(inside.sum(axis=(1, 2)), 1)


def hue(colors: np.ndarray) -> np.ndarray:
    """What colours (..., 3) have beside their mean channel; grey has none."""
    return colors - colors.mean(axis=-1, keepdims=True)


def color_scores(item: data_sets.ObjectData, reference: np.ndarray, image: np.ndarray) -> Scores:
    """PSNR of the mean colour inside the silhouette, and of its hue, of each view: whether a red car is red."""
    pair = [mean_colors(item, picture) for picture in (image, reference)]
    return {"color": _psnr_of_colors(pair), "hue": _psnr_of_colors([hue(colors) for colors in pair])}


def _psnr_of_colors(pair: list[np.ndarray]) -> np.ndarray:
    return np.asarray(
        psnr(*(jnp.asarray(colors, jnp.float32)[:, None, None] for colors in pair))
    )  # pictures of a pixel
