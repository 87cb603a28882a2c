"""A contact sheet of a data set: one self-contained HTML page, for looking.

Per object: its pictures, its condition images, and its points as a front view in base colour, roughness and metallic.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from data_gen.render import views
from data_gen.store import check, layout
from spnr_jax.errors import UserError, require_at_least
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import Dataset, on_white
from spnr_jax.formats.images import png_url, template, to_uint8, write_whole
from spnr_jax.kernels.imaging import linear_to_srgb
from spnr_jax.kernels.records import PointCloud

CHANNELS = ("base_color", "roughness", "metallic")  # that are shown of points
POINT_IMAGE = 128  # pixels
BACKDROP = np.array([186, 202, 222], np.uint8)  # neither black nor white, which roughness and metallic often are


@dataclass(frozen=True, kw_only=True)
class ShowConfig:
    """Write a contact sheet of a data set as one HTML file."""

    dataset: tyro.conf.Positional[Path]
    """Folder of the data set."""
    to: Path | None = None
    """The HTML file (default: contact_sheet.html in the data set's folder)."""
    objects: int = 48
    """Show at most this many objects, spread evenly over the data set."""


def show(config: ShowConfig) -> Path:
    """Write the contact sheet; return its path."""
    check.read_description(config.dataset)
    require_at_least(config, 1, "objects")
    object_ids = sorted(layout.list_completed(config.dataset))
    if not object_ids:
        raise UserError(f"{config.dataset} holds no objects/ID/object.json yet, which spnr-data generate writes last")
    chosen = np.unique(np.linspace(0, len(object_ids) - 1, min(config.objects, len(object_ids))).round().astype(int))
    page = template(Path(__file__).with_name("contact_sheet.html")).render(
        title=f"{config.dataset.resolve().name}: {len(chosen)} of {len(object_ids)} objects",
        objects=describe_objects(config.dataset, [object_ids[index] for index in chosen]),
    )
    path = config.to or config.dataset / "contact_sheet.html"
    write_whole(path, page.encode())
    print(path)
    return path


def describe_objects(dataset: Path, names: list[str]) -> Iterator[dict]:
    """The objects as the page shows them, without damaged ones, which are named on stderr."""
    for name in names:
        try:
            yield shown(dataset, name)
        except UserError as error:
            print(f"left out: {error}", file=sys.stderr)


def shown(dataset: Path, object_id: str) -> dict:
    """An object as the page shows it: its name, what it is, and rows of pictures, each a width and an address."""
    item = data_sets.read_object(Dataset(folder=dataset, settings={}, splits={}), object_id)
    details = check.read_details(dataset, object_id)
    ignored = "; ".join(details["ignored"])
    rows = {
        "pictures": [to_uint8(on_white(image)) for image in item.images],
        "visible": [to_uint8(on_white(condition)) for condition in item.conditions],
        "points": [point_image(item.cloud, name) for name in CHANNELS],
    }
    return {
        "name": object_id,
        "note": f"{details['category']}{', ignored: ' + ignored if ignored else ''}",
        "rows": {label: [(max(96, x.shape[1]), png_url(x)) for x in pictures] for label, pictures in rows.items()},
    }


def point_image(cloud: PointCloud, channel: str) -> np.ndarray:
    """The points seen obliquely from the front as (128, 128, 3) uint8, near ones over far ones."""
    camera = views.ViewConfig(resolution=POINT_IMAGE)
    pose = views.look_at(camera.distance * np.array([0.5, 0.4, 0.77]))
    positions, values = np.asarray(cloud.positions, np.float64), np.asarray(getattr(cloud, channel))
    shown = linear_to_srgb(values) if values.ndim == 2 else np.repeat(values[:, None], 3, axis=1)
    colors = np.asarray(np.round(255 * shown), np.uint8)
    far_first = np.argsort((positions - pose[:3, 3]) @ pose[:3, 2])
    columns, rows = np.floor(views.project(pose, positions, camera)).astype(int).clip(0, POINT_IMAGE - 2)[far_first].T
    canvas = np.tile(BACKDROP, (POINT_IMAGE, POINT_IMAGE, 1))
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):  # a dot is two pixels wide
        canvas[rows + down, columns + right] = colors[far_first]
    return canvas
