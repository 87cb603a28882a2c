"""What the study of sharpness compares: networks, discs and light alone, Poisson surfaces, pictures made elsewhere."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from data_gen.store import layout
from experiments.comparison.object_views import Picture, at, drawn, on_white, view_of
from experiments.comparison.poisson import Renderer, trimmed_surface
from spnr_jax.config import SurfelConfig
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.method.model import Model, Quality
from spnr_jax.training.weights import load


class Drawn(NamedTuple):
    """Pictures of an object's views, and seconds: to encode it, and of a picture once all is compiled."""

    pictures: list[Picture]
    encode: float | None
    render: float | None


@dataclass(frozen=True)
class Network:
    """A trained network at a quality; `draft` of the one over surfels is discs and light alone."""

    label: str
    model: Model
    quality: Quality

    def draw(self, item: data_sets.ObjectData, resolution: int | None) -> Drawn:
        """The pictures, drawn twice: the second time is measured."""
        self.model.encode(item.cloud)
        begin = perf_counter()
        volume = self.model.encode(item.cloud)
        jax.block_until_ready(jax.tree.leaves(volume.scene))
        encode = perf_counter() - begin
        views = [view_of(item, view, resolution)[0] for view in range(len(item.images))]
        for _ in range(2):
            begin = perf_counter()
            found = drawn(self.model, volume, views, self.quality)
            seconds = (perf_counter() - begin) / len(views)
        size = views[0].height, views[0].width
        return Drawn([(image, resized(opacity, size)) for image, opacity in found], encode, seconds)


@dataclass(frozen=True)
class Poisson:
    """Trimmed Poisson surfaces, path-traced by Mitsuba in the light of the data set."""

    label: str
    renderer: Renderer

    def draw(self, item: data_sets.ObjectData, resolution: int | None) -> Drawn:
        """The pictures; empty ones where the points span no surface."""
        begin = perf_counter()
        asset = trimmed_surface(item.cloud)
        middle = perf_counter()
        rgba = self.renderer.drawn(asset, item) if asset.parts else np.zeros_like(item.images)
        seconds = (perf_counter() - middle) / len(rgba)
        return Drawn([on_white(at(picture, resolution)) for picture in rgba], middle - begin, seconds)


@dataclass(frozen=True)
class Elsewhere:
    """Pictures that another program made of the same points and cameras: FOLDER/POINTS/ID/000.png, a view each."""

    label: str
    folder: Path

    def draw(self, item: data_sets.ObjectData, resolution: int | None) -> Drawn:
        """The pictures, read; UserError for one that is missing or of another size."""
        place, found = self.folder / str(len(item.cloud.positions)) / item.name, []
        for view in range(len(item.images)):
            path = place / f"{view:03d}.png"
            picture = layout.read_image(path)
            if picture.shape != item.images[view].shape:
                raise UserError(
                    f"{path}: {picture.shape}, expected {item.images[view].shape}: RGBA like the references"
                )
            found.append(on_white(at(picture, resolution)))
        return Drawn(found, None, None)


Method = Network | Poisson | Elsewhere


def methods(
    runs: Sequence[str], poisson: bool, folders: Sequence[Path], dataset: data_sets.Dataset
) -> tuple[Method, ...]:
    """The methods of a study by their order in its tables."""
    found: list[Method] = []
    for run in runs:
        model = load(run)
        found.append(Network(run, model, "best"))
        if isinstance(model.config, SurfelConfig):
            found.append(Network(f"{run}, discs and light alone", model, "draft"))
    if poisson:
        found.append(Poisson("Poisson, trimmed", Renderer(dataset.settings)))
    return (*found, *(Elsewhere(folder.name, folder) for folder in folders))


def resized(opacity: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An opacity at the size of its picture: the paper's network has it at half of that."""
    return opacity if opacity.shape == size else np.asarray(jax.image.resize(jnp.asarray(opacity), size, "linear"))
