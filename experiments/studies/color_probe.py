"""Where a network of rays loses the colours of its points: linear probes of its layers, and the hue of its pictures.

    python -m experiments.studies.color_probe --data DIR --out OUT --runs RUN [RUN ...]

A line for each layer of the encoder: how much of the brightness and hue of the points' base colours a linear map of the
layer's features tells, fitted on training objects and asked of unseen ones (share of the variance; 1 is all, 0 no more
than their mean).  Features of a volume are those of the voxel that holds the point.  And how far the hue of a view
follows that of its reference: slope and correlation, over all test views, of the mean colour inside the silhouette less
its mean channel; slope 1 and correlation 1 are right, a grey picture has slope 0.

    OUT/results.json  OUT/table.md .csv .tex
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments import entry_point
from experiments.comparison import results_folder
from experiments.comparison.object_scores import hue, mean_colors
from experiments.comparison.trained_networks import Network, Sources, networks
from spnr_jax import cli
from spnr_jax.devices import machine
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets
from spnr_jax.kernels import voxels
from spnr_jax.kernels.colors import linear_to_srgb
from spnr_jax.model_config import RayNetworkConfig
from spnr_jax.nn.encoder import BRIGHTNESS_AND_HUE, Encoder
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.score_tables import Cell, Table, number

RIDGE = 1e-3  # of the features' mean square, against directions that hold next to nothing
LAYERS = {"points": "features of the PointNet", "stem": "after the stem", "volume": "the volume"}
Features = dict[str, Float[np.ndarray, "points channels"]]


@dataclass(frozen=True, kw_only=True)
class ColorProbe:
    """Ask the layers of trained networks of rays for the colours of the points."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the results."""
    runs: tuple[Path, ...]
    """Run folders, files of weights, or `small` or `tiny`, the networks in the package."""
    objects: int = 60
    """Training objects that the linear maps are fitted on."""

    def __post_init__(self) -> None:
        at_least(self, 1, "objects")


def main(options: ColorProbe) -> None:
    """Probes every network, writes the table."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    found = {
        name: probed(network, dataset, options)
        for name, network in networks(Sources(runs=options.runs), dataset).items()
    }
    rows = tuple(row for name, values in found.items() for row in rows_of(name, values))
    heads = ("brightness", "hue: green to red", "blue to yellow", "slope", "correlation")
    title = "What a linear map of each layer tells of base colours, and how far the hue of pictures follows"
    results = {"networks": found, "hardware": machine.hardware()}
    results_folder.write(options.out, results, [Table(title=title, heads=heads, rows=rows)])


def rows_of(name: str, values: dict) -> Iterable[tuple[str, tuple[Cell, ...]]]:
    """A line for each layer of a network, and one for its pictures."""
    for layer, told in values["layers"].items():
        yield f"{name}, {LAYERS[layer]}", tuple(number(value, 2, missing="") for value in (*told, None, None))
    yield f"{name}, pictures", tuple(number(value, 2, missing="") for value in (None, None, None, *values["hue"]))


def probed(network: Network, dataset: data_sets.Dataset, options: ColorProbe) -> dict:
    """The shares of variance by layer, and slope and correlation of the hue of pictures."""
    if not isinstance(network.config.model, RayNetworkConfig):
        raise UserError(f"--runs: {network.method} has no volume of features; name networks of rays")
    fitted, fit_colors = features(network, dataset, evaluation.spread(dataset.splits["train"], options.objects))
    asked, asked_colors = features(network, dataset, dataset.splits["test"])
    layers = {layer: told(fitted[layer], fit_colors, asked[layer], asked_colors) for layer in LAYERS}
    return {"layers": layers, "hue": hue_followed(network, dataset)}


def features(
    network: Network, dataset: data_sets.Dataset, names: tuple[str, ...]
) -> tuple[Features, Float[np.ndarray, "points 3"]]:
    """What each layer holds at the points of some objects, and brightness and hue of their base colours."""
    model = network.config.model
    assert isinstance(model, RayNetworkConfig)
    encoder = Encoder(model.encoder)
    weights = {kind: network.variables.get(kind, {}).get("encoder", {}) for kind in ("params", "batch_stats")}

    @jax.jit
    def layers(cloud):
        volume, inside = encoder.apply(weights, cloud, capture_intermediates=True)
        x, y, z = jnp.moveaxis(voxels.locate(cloud.positions[0], model.encoder.volume_resolution)[0], -1, 0)
        (stem,) = inside["intermediates"]["unet"]["stem"]["__call__"]
        (points,) = inside["intermediates"]["pointnet"]["__call__"]
        return {"points": points[0], "stem": stem[0, z, y, x], "volume": volume[0, z, y, x]}

    found, colors = [], []
    for name in names:
        cloud = data_sets.test_cloud(data_sets.read_object(dataset, name), network.config)
        found.append(jax.device_get(layers(jax.tree.map(lambda x: jnp.asarray(x)[None], cloud))))
        colors.append((np.asarray(linear_to_srgb(jnp.asarray(cloud.base_color))) - 0.5) @ BRIGHTNESS_AND_HUE)
    return {layer: np.concatenate([one[layer] for one in found]) for layer in LAYERS}, np.concatenate(colors)


def told(
    fitted: Float[np.ndarray, "n channels"],
    values: Float[np.ndarray, "n values"],
    asked: Float[np.ndarray, "m channels"],
    truth: Float[np.ndarray, "m values"],
) -> list[float]:
    """Share of the variance of each value that a linear map tells, which was fitted (ridge regression) elsewhere."""
    center, mean = np.mean(fitted, axis=0), np.mean(values, axis=0)
    x = np.asarray(fitted - center, np.float64)
    square = x.T @ x
    ridge = RIDGE * np.trace(square) / len(square) * np.eye(len(square))
    error = (asked - center) @ np.linalg.solve(square + ridge, x.T @ (values - mean)) + mean - truth
    return (1 - np.mean(error**2, axis=0) / np.var(truth, axis=0)).tolist()


def hue_followed(network: Network, dataset: data_sets.Dataset) -> tuple[float, float]:
    """Slope and correlation of the mean hues of all test views against those of their references."""
    method, pairs = network.show(), []
    for name in dataset.splits["test"]:
        item = data_sets.read_object(dataset, name)
        image = method(data_sets.test_cloud(item, network.config), item.camera).image
        pairs.append([mean_colors(item, picture) for picture in (data_sets.on_white(item.images), np.asarray(image))])
    reference, drawn = (hue(np.concatenate(colors)) for colors in zip(*pairs, strict=True))
    product, power = np.sum(reference * drawn), np.sum(reference**2)
    return float(product / power), float(product / np.sqrt(power * np.sum(drawn**2)))


if __name__ == "__main__":
    entry_point.run(main, ColorProbe, "studies.color_probe")
