"""Every reader of other people's files, as a command calls it, with the law of what it may return.

`READERS` maps a name to a Reader: valid seeds, and `read`, which opens the files in a folder.  It returns when the
file was read and what came is sound (finite, right shapes and types), raises ValueError, one line, when the file is
refused, and AssertionError when something unsound was let through.
"""

import contextlib
import functools
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import browser_messages
import numpy as np
import packed_gltfs
import valid_files
import valid_runs
from damage import Files

MOST_POINTS = 32


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A kind of files: `seeds` makes valid ones, `read(folder, main)` reads the file `main` there."""

    seeds: Callable[[], list[Files]]
    read: Callable[[Path, str], None]


def read_cloud(folder: Path, main: str) -> None:
    """What `spnr render` and `spnr view` do with a file of points or a mesh."""
    from spnr_jax.formats import clouds

    placed = clouds.place_cloud(folder / main, num_points=MOST_POINTS, report=lambda line: None)
    check_cloud(placed.cloud, MOST_POINTS)
    assert np.isfinite(placed.origin).all()
    assert np.linalg.det(placed.rotation) > 0.99


def read_mesh(folder: Path, main: str) -> None:
    """What the generator of data makes of a mesh file, and `spnr render` with either choice of transparent parts."""
    from spnr_jax.formats import clouds
    from spnr_jax.formats.mesh import assets, meshes, surface_points

    with contextlib.suppress(assets.RejectedAsset):  # more is refused for references than for pictures
        surface_points.sample_surface(meshes.load_mesh(folder / main), MOST_POINTS, 0)
    with contextlib.suppress(ValueError):
        cloud = clouds.read_cloud(folder / main, num_points=MOST_POINTS, transparent_parts="skip")
        check_cloud(cloud, MOST_POINTS)
    read_cloud(folder, main)


def check_cloud(cloud, most: int | None = None) -> None:
    """AssertionError unless the cloud is finite float32 with materials in [0, 1]."""
    count = len(cloud.positions)
    assert count >= 1, "no points"
    assert most is None or count <= most, f"{count} points"
    shapes = {"positions": (count, 3), "base_color": (count, 3), "roughness": (count,), "metallic": (count,)}
    for name, shape in shapes.items():
        values = np.asarray(getattr(cloud, name))
        assert values.shape == shape, f"{name} {values.shape}"
        assert values.dtype == np.float32, f"{name} {values.dtype}"
        assert np.isfinite(values).all(), f"{name} not finite"
        if name != "positions":
            assert values.min() >= 0, f"{name} below 0"
            assert values.max() <= 1, f"{name} above 1"
    assert cloud.mask.dtype == bool
    assert cloud.mask.all()


def read_config(folder: Path, main: str) -> None:
    """A run folder's config."""
    from spnr_jax.methods import from_dict, to_dict
    from spnr_jax.training.checkpoint import read_config

    config = read_config(folder)
    hash(config)  # it is a static argument of jit
    assert from_dict(to_dict(config)) == config, "a config that is not itself again"


def read_metrics(folder: Path, main: str) -> None:
    """The rows that a report draws."""
    from spnr_jax.training.metrics_log import read_rows

    for row in read_rows(folder):
        assert isinstance(row, dict), f"a row that is a {type(row).__name__}"
        assert all(isinstance(value, int | float) for value in row.values()), "a row with a value that is no number"


def read_dataset(folder: Path, main: str) -> None:
    """Every object of a data set, as training reads it."""
    from spnr_jax.formats import data_sets

    dataset = data_sets.open_dataset(folder)
    for name in dataset.splits["train"][:3]:
        item = data_sets.read_object(dataset, name)
        check_cloud(item.cloud)
        views, height, width = len(item.camera.cam_to_world), item.camera.height, item.camera.width
        for images in (item.images, item.conditions):
            assert images.shape == (views, height, width, 4), f"images {images.shape}"
            assert images.dtype == np.uint8
        assert views >= 1, "no views"
        assert item.camera.cam_to_world.shape == (views, 3, 4), f"cameras {item.camera.cam_to_world.shape}"
        assert item.camera.intrinsics.shape == (views, 3, 3)
        assert np.isfinite(item.camera.cam_to_world).all()
        assert np.isfinite(item.camera.intrinsics).all()
        assert (np.asarray(item.camera.intrinsics)[:, (0, 1), (0, 1)] > 0).all(), "a focal length below 0"


def check_dataset(folder: Path, main: str) -> None:
    """What `spnr-data check` says."""
    from data_gen.store import check

    with contextlib.redirect_stdout(io.StringIO()):
        sound = check.check(folder)
    assert isinstance(sound, bool)


def read_list(folder: Path, main: str) -> None:
    """Splits that a user names, and the tables of other data sets."""
    from data_gen.plan import sources, splits

    path, known = folder / main, {"a", "b"}
    if main.startswith("3dmodels"):
        for name in sources.read_table(path).values():
            place = (folder / "models" / name).resolve()
            assert place.is_relative_to((folder / "models").resolve()), "a product outside its folder"
        return
    listed = splits.read_test_list(path, known) if main == "list.txt" else splits.read_split_file(path, known, None)
    assert set().union(*listed.values()) <= known
    assert set(listed) <= {"train", "val", "test"}


def read_network(folder: Path, main: str) -> None:
    """A file of weights."""
    from spnr_jax.training.weights import Trained, read_weights

    assert isinstance(read_weights(folder / main), Trained)


CLOUDS: dict[str, Callable[[], list[Files]]] = {
    "ply": valid_files.plys, "ply-mesh": valid_files.ply_meshes, "pcd": valid_files.pcds, "text": valid_files.texts,
    "npz": valid_files.npzs, "npy": valid_files.npys, "las": functools.partial(valid_files.scans, "las"),
    "laz": functools.partial(valid_files.scans, "laz"), "stl": valid_files.stls, "off": valid_files.offs,
    "spz": valid_files.spzs,
}  # fmt: skip
MESHES: dict[str, Callable[[], list[Files]]] = {
    "obj": valid_files.objs,
    "gltf": valid_files.gltfs,
    "glb": valid_files.glbs,
    "gltf-packed": packed_gltfs.packed,
    "gltf-looks": packed_gltfs.looks,
}
READERS = {
    **{name: Reader(seeds=seeds, read=read_cloud) for name, seeds in CLOUDS.items()},
    **{name: Reader(seeds=seeds, read=read_mesh) for name, seeds in MESHES.items()},
    "config": Reader(seeds=valid_runs.configs, read=read_config),
    "metrics": Reader(seeds=valid_runs.metric_rows, read=read_metrics),
    "dataset": Reader(seeds=valid_runs.datasets, read=read_dataset),
    "dataset-check": Reader(seeds=valid_runs.datasets, read=check_dataset),
    "lists": Reader(seeds=valid_runs.lists, read=read_list),
    "viewer-message": Reader(seeds=browser_messages.messages, read=browser_messages.read_message),
    "viewer-upload": Reader(seeds=browser_messages.sent_files, read=browser_messages.read_upload),
    "weights": Reader(seeds=valid_runs.weights, read=read_network),
}
