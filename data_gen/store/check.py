"""Whether a data set is sound: every file readable and as it was written, its parts in agreement with each other."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from data_gen.store import layout
from spnr_jax.errors import UserError
from spnr_jax.formats.npz import read_arrays
from spnr_jax.surfels.lighting import HEIGHT, WIDTH

COUNTS = ("views", "resolution", "points")  # settings that the files of every object are compared with
LEAST_AGREEMENT = 0.9  # of the visible points, on opaque pixels; the rest sit on silhouettes, where pixels are cut


def check(dataset: Path) -> bool:
    """Print a table of what was found and each fault on a line of its own; return whether the data set is sound."""
    description = read_description(dataset)
    settings = description.get("settings")
    if not isinstance(settings, dict) or not all(isinstance(settings.get(name), int) for name in COUNTS):
        raise UserError(f"{dataset / 'dataset.json'}: expected settings {', '.join(COUNTS)}; generate it again")
    described = description.get("environment_map")
    own_lights = isinstance(described, dict) and "kinds" in described
    object_ids = sorted(layout.list_completed(dataset))
    splits, faults = read_splits(dataset)
    faults += split_faults(splits, set(object_ids)) if not faults else []
    agreements, covered, num_views = [], [], 0
    details = {}
    for object_id in object_ids:
        folder = dataset / "objects" / object_id
        try:
            record = layout.read_object(folder)
            found = object_faults(folder, record, settings, own_lights)
        except (ValueError, OSError) as error:
            faults.append(f"{object_id}: {type(error).__name__}: {error}")
            continue
        agreement = points_on_object(record)
        if agreement < LEAST_AGREEMENT:
            found.append(f"only {agreement:.0%} of the visible points fall on opaque pixels")
        faults += [f"{object_id}: {fault}" for fault in found]
        agreements.append(agreement)
        covered.append((record.images[..., 3] > 0).mean())
        num_views += len(record.images)
        details[object_id] = record.details
    faults += variant_faults(splits, details)
    print_table(dataset, object_ids, splits, num_views, agreements, covered, faults)
    return not faults


def read_description(dataset: Path) -> dict:
    """The dict of dataset.json; ValueError if there is none of this schema."""
    path = dataset / "dataset.json"
    if not path.is_file():
        raise UserError(f"{dataset} holds no data set: {path.name} is missing; make one with spnr-data generate")
    description = layout.read_document(path)
    if description.get("schema_version") != layout.SCHEMA_VERSION:
        found = description.get("schema_version")
        raise UserError(f"{path}: expected schema version {layout.SCHEMA_VERSION}, got {found}; generate it again")
    return description


def read_splits(dataset: Path) -> tuple[dict[str, list[str]], list[str]]:
    """The ids of the splits whose lists are there, and what is wrong where one is not."""
    splits, faults = {}, []
    for split in layout.SPLITS:
        try:
            splits[split] = layout.read_split(dataset, split)
        except OSError as error:
            missing = f"{error.filename}: {error.strerror}"
            faults = [f"{missing}; the run has not finished: repeat the command that began it"]
    return splits, faults


def split_faults(splits: Mapping[str, list[str]], object_ids: set[str]) -> list[str]:
    """What is wrong with the splits: each object has to be in exactly one."""
    listed = [object_id for ids in splits.values() for object_id in ids]
    faults = []
    if twice := sorted({object_id for object_id in listed if listed.count(object_id) > 1}):
        faults.append(f"splits: {twice[0]} is listed more than once ({len(twice)} such objects)")
    if absent := sorted(set(listed) - object_ids):
        faults.append(f"splits: {absent[0]} is listed but has no folder ({len(absent)} such objects)")
    if unlisted := sorted(object_ids - set(listed)):
        faults.append(f"splits: {unlisted[0]} is in no split ({len(unlisted)} such objects)")
    return faults


def variant_faults(splits: Mapping[str, list[str]], details: dict[str, dict]) -> list[str]:
    """What is wrong with colour variants: all of a product are in one split, and only train has any."""
    split_of = {object_id: split for split, ids in splits.items() for object_id in ids}
    faults: list[str] = []
    of_product: dict[str, set[str]] = {}
    for object_id, detail in details.items():
        split = split_of.get(object_id)
        if split is None:
            continue
        of_product.setdefault(str(detail.get("product")), set()).add(split)
        if detail.get("variant") and split != "train":
            faults.append(f"splits: {object_id} is a colour variant, but in {split}; only training objects have any")
    for product, found in sorted(of_product.items()):
        if len(found) > 1:
            faults.append(f"splits: variants of {product} are in {' and '.join(sorted(found))}")
    return faults


def object_faults(folder: Path, record: layout.ObjectRecord, settings: dict, own_lights: bool) -> list[str]:
    """What is wrong with one object."""
    files = record.details.get("files", {})
    if not isinstance(files, dict) or not {"product", "variant"} <= record.details.keys():
        return ["object.json: expected files, product and variant"]
    damaged = [name for name, checksum in files.items() if checksum_of(folder / name) != checksum]
    faults = [f"{name} has another checksum than when it was written" for name in damaged]
    size = (settings["views"], settings["resolution"], settings["resolution"], 4)
    for name in ("images", "conditions"):
        if getattr(record, name).shape != size:
            faults.append(f"{name}: expected {size}, got {getattr(record, name).shape}")
    faults += camera_faults(record.transforms) + point_faults(record.points, settings["points"])
    return faults + light_faults(folder, "lights.npz" in files, len(record.images), own_lights)


def checksum_of(path: Path) -> str | None:
    """The SHA-256 of a file, or None if there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def camera_faults(transforms: dict) -> list[str]:
    """What is wrong with the cameras of one object."""
    poses = np.array([frame["transform_matrix"] for frame in transforms["frames"]], np.float64)
    rotations = poses[:, :3, :3]
    products = rotations @ rotations.transpose(0, 2, 1)
    if not np.allclose(products, np.eye(3), atol=1e-6) or not np.allclose(np.linalg.det(rotations), 1, atol=1e-6):
        return ["a camera's axes are not a right-handed orthonormal frame"]
    return []


def point_faults(points: np.ndarray, count: int) -> list[str]:
    """What is wrong with the points of one object."""
    faults = [] if len(points) == count else [f"expected {count} points, got {len(points)}"]
    values = layout.point_columns(points, *layout.POINT_FIELDS)
    if not np.isfinite(values).all():
        return [*faults, "points hold values that are not finite"]
    if np.linalg.norm(values[:, :3], axis=1).max(initial=0) > 1 + 1e-5:
        faults.append("points lie outside the unit sphere")
    if np.abs(np.linalg.norm(values[:, 3:6], axis=1) - 1).max(initial=0) > 1e-3:
        faults.append("normals are not of length 1")
    if values[:, 6:].min(initial=0) < 0 or values[:, 6:].max(initial=0) > 1:
        faults.append("colours or materials lie outside [0, 1]")
    return faults


def light_faults(folder: Path, listed: bool, views: int, own_lights: bool) -> list[str]:
    """What is wrong with the lights of one object's views, which its files list where each view has its own."""
    if listed != own_lights:
        said = "a light of its own for each view" if own_lights else "one light for all"
        return [f"lights.npz is {'there' if listed else 'missing'}, but dataset.json says {said}"]
    if not own_lights:
        return []
    try:
        with (folder / "lights.npz").open("rb") as file:
            lights = read_arrays(file, ("lights",))["lights"]
    except OSError:
        return []  # a missing file has another checksum, which is told already
    except UserError as error:
        return [f"lights.npz {error}"]
    if lights.shape != (views, HEIGHT, WIDTH, 3) or lights.dtype.kind != "f":
        return [f"lights.npz: expected floats {(views, HEIGHT, WIDTH, 3)}, got {lights.dtype} {lights.shape}"]
    if not np.isfinite(lights).all() or lights.min() < 0:
        return ["lights.npz holds radiance that is negative or not finite"]
    dark = [view for view, light in enumerate(lights) if not light.any()]
    return [f"lights.npz: view {dark[0]} is lit by a black map"] if dark else []


def points_on_object(record: layout.ObjectRecord) -> float:
    """The share of condition pixels (visible points) that are opaque or partly so in their pictures."""
    seen = record.conditions[..., 3] > 0
    return float((record.images[..., 3][seen] > 0).mean()) if seen.any() else 1.0


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
