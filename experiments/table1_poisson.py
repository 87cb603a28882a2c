"""Poisson reconstruction as rows of the table: rendered by Mitsuba as the references were, kept on disk by object.

FOLDER/NAME/000.png     RGBA, sRGB, straight alpha, one for each view
FOLDER/NAME/made.json   seconds, number of views, and why the pictures are empty (""); there once they all are
"""

import json
import time
from pathlib import Path

import numpy as np

from data_gen.render.poisson_surface import PoissonConfig
from data_gen.store import layout
from experiments.poisson import Renderer
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.scoring.evaluation import Pictures

SURFACES = {"poisson": PoissonConfig(), "poisson_trimmed": PoissonConfig(trim=0.3)}


def show(renderer: Renderer, points: int, surface: PoissonConfig, folder: Path, item: data_sets.ObjectData) -> Pictures:
    """Image and opacity of the surface of an object's first points, in all its views; read where they are made."""
    note = folder / item.name / "made.json"
    paths = [folder / item.name / f"{view:03d}.png" for view in range(len(item.images))]
    if not note.is_file():
        start = time.monotonic()
        pictures, empty = renderer.pictures(item, points, surface)
        seconds = time.monotonic() - start
        for path, picture in zip(paths, pictures, strict=True):
            write_whole(path, layout.encode_image(picture))
        made = {"seconds": round(seconds, 4), "views": len(paths), "empty": empty}
        write_whole(note, layout.json_text(made).encode())
    rgba = np.stack([layout.read_image(path) for path in paths])
    return Pictures(image=data_sets.on_white(rgba), acc=rgba[..., 3].astype(np.float32) / 255)


def seconds_per_view(folder: Path, names: tuple[str, ...]) -> list[float]:
    """Seconds of solver and renderer by object, shared by its views."""
    notes = [json.loads((folder / name / "made.json").read_text()) for name in names]
    return [note["seconds"] / note["views"] for note in notes]
