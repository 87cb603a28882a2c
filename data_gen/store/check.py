"""Whether a data set is sound: every file readable and as it was written, its parts in agreement with each other."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from data_gen.store import layout
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import Dataset, ObjectData
from spnr_jax.kernels.records import PointCloud

COUNTS = ("views", "resolution", "points")  # settings that the files of every object are compared with
LEAST_AGREEMENT = 0.9  # of the visible points, on opaque pixels; the rest sit on silhouettes, where pixels are cut


def check(dataset: Path) -> bool:
    """Print a table of what was found and each fault on a line of its own; return whether the data set is sound."""
    description = read_description(dataset)
    settings = description.get("settings")
    if not isinstance(settings, dict) or not all(isinstance(settings.get(name), int) for name in COUNTS):
        raise UserError(f"{dataset / 'dataset.json'}: expected settings {', '.join(COUNTS)}; generate it again")
    data = Dataset(folder=dataset, settings=description, splits={})
    object_ids = sorted(layout.list_completed(dataset))
    splits, faults = read_splits(dataset)
    faults += split_faults(splits, set(object_ids)) if not faults else []
    agreements, covered, num_views = [], [], 0
    for object_id in object_ids:
        try:
            item = data_sets.read_object(data, object_id)
            found = object_faults(data, item, read_details(dataset, object_id))
        except (ValueError, OSError) as error:
            faults.append(f"{object_id}: {error}")
            continue
        agreement = points_on_object(item)
        if agreement < LEAST_AGREEMENT:
            found.append(f"only {agreement:.0%} of the visible points fall on opaque pixels")
        faults += [f"{object_id}: {fault}" for fault in found]
        agreements.append(agreement)
        covered.append((item.images[..., 3] > 0).mean())
        num_views += len(item.images)
    print_table(dataset, object_ids, splits, num_views, agreements, covered, faults)
    return not faults


def read_description(dataset: Path) -> dict:
    """The dict of dataset.json; ValueError if there is none of this schema."""
    path = dataset / "dataset.json"
    if not path.is_file():
        raise UserError(f"{dataset} holds no data set: {path.name} is missing; make one with spnr-data generate")
    description = read_document(path)
    if description.get("schema_version") != layout.SCHEMA_VERSION:
        found = description.get("schema_version")
        raise UserError(f"{path}: expected schema version {layout.SCHEMA_VERSION}, got {found}; generate it again")
    return description


def read_details(dataset: Path, object_id: str) -> dict:
    """The dict of an object.json."""
    return read_document(dataset / "objects" / object_id / layout.LAST_FILE)


def read_document(path: Path) -> dict:
    """The dict of a JSON file; ValueError or OSError if there is none."""
    try:
        document = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not readable ({error}); generate it again") from None
    if not isinstance(document, dict):
        raise UserError(f"{path}: expected named entries, found {type(document).__name__}; generate it again")
    return document


def read_splits(dataset: Path) -> tuple[dict[str, list[str]], list[str]]:
    """The ids of the splits whose lists are there, and what is wrong where one is not."""
    splits, faults = {}, []
    for split in layout.SPLITS:
        try:
            splits[split] = (dataset / "splits" / f"{split}.txt").read_text().split()
        except OSError as error:
            missing = f"{error.filename}: {error.strerror}"
            faults += [f"{missing}; the run has not finished: repeat the command that began it"]
    return splits, faults


def split_faults(splits: Mapping[str, list[str]], object_ids: set[str]) -> list[str]:
    """What is wrong with the splits: each object has to be in exactly one."""
    listed = [object_id for ids in splits.values() for object_id in ids]
    faults = []
    if twice := sorted(object_id for object_id, times in Counter(listed).items() if times > 1):
        faults.append(f"splits: {twice[0]} is listed more than once ({len(twice)} such objects)")
    if absent := sorted(set(listed) - object_ids):
        faults.append(f"splits: {absent[0]} is listed but has no folder ({len(absent)} such objects)")
    if unlisted := sorted(object_ids - set(listed)):
        faults.append(f"splits: {unlisted[0]} is in no split ({len(unlisted)} such objects)")
    return faults


def object_faults(data: Dataset, item: ObjectData, details: dict) -> list[str]:
    """What is wrong with one object."""
    files, settings = details.get("files"), data.settings["settings"]
    if not isinstance(files, dict):
        return ["object.json: expected the checksums of its files"]
    folder = data.folder / "objects" / item.name
    damaged = [name for name, checksum in files.items() if checksum_of(folder / name) != checksum]
    faults = [f"{name} has another checksum than when it was written" for name in damaged]
    size, found = (settings["views"], settings["resolution"]), (len(item.images), item.camera.height)
    if size != found:
        faults.append(f"expected (views, resolution) {size}, got {found}")
    if ("lights.npz" in files) != (item.lights is not None):
        faults.append("lights.npz is there, but dataset.json says one light for all")
    for view in np.flatnonzero(~np.any(item.lights, axis=(1, 2, 3))) if item.lights is not None else ():
        faults.append(f"lights.npz: view {view} is lit by a black map")
    rotations = np.asarray(item.camera.cam_to_world, np.float64)[:, :, :3]
    products = rotations @ rotations.transpose(0, 2, 1)
    if not np.allclose(products, np.eye(3), atol=1e-5) or not np.allclose(np.linalg.det(rotations), 1, atol=1e-5):
        faults.append("a camera's axes are not a right-handed orthonormal frame")
    return faults + point_faults(item.cloud, settings["points"])


def checksum_of(path: Path) -> str | None:
    """The SHA-256 of a file, or None if there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def point_faults(cloud: PointCloud, count: int) -> list[str]:
    """What is wrong with the points of one object."""
    faults = [] if len(cloud.positions) == count else [f"expected {count} points, got {len(cloud.positions)}"]
    if np.linalg.norm(cloud.positions, axis=1).max() > 1 + 1e-5:
        faults.append("points lie outside the unit sphere")
    if cloud.normals is None or np.abs(np.linalg.norm(cloud.normals, axis=1) - 1).max() > 1e-3:
        faults.append("normals are not of length 1")
    values = np.column_stack([cloud.base_color, cloud.roughness, cloud.metallic])
    if values.min() < 0 or values.max() > 1:
        faults.append("colours or materials lie outside [0, 1]")
    return faults


def points_on_object(item: ObjectData) -> float:
    """The share of condition pixels (visible points) that are opaque or partly so in their pictures."""
    seen = item.conditions[..., 3] > 0
    return float((item.images[..., 3][seen] > 0).mean()) if seen.any() else 1.0


def print_table(dataset: Path, object_ids, splits, num_views: int, agreements, covered, faults) -> None:
    """Print the figures of a data set and its faults."""
    rows: list[tuple[str, object]] = [("objects", len(object_ids)), ("views", num_views)]
    rows += [(split, len(ids)) for split, ids in splits.items()]
    if (dataset / "rejected.jsonl").is_file():
        rows.append(("left out", len((dataset / "rejected.jsonl").read_text().splitlines())))
    if agreements:
        rows.append(("visible points on the object", f"{np.mean(agreements):.2%} (worst {min(agreements):.2%})"))
        rows.append(("picture covered by the object", f"{np.mean(covered):.1%}"))
    rows.append(("faults", len(faults)))
    print(dataset)
    for name, value in rows:
        print(f"  {name:<32}{value}")
    for fault in faults:
        print(f"  FAULT {fault}")
