"""The files of a data set, written; spnr_jax/formats/data_sets.py reads them.

    DATASET/dataset.json, splits/{train,val,test}.txt, rejected.jsonl
    DATASET/objects/ID/{points.ply, transforms.json, images/000.png, conditions/000.png, object.json}
    DATASET/objects/ID/lights.npz where each view has its own light: `lights` (views, 32, 64, 3) linear radiance

Everything written is a function of its content alone (no clock, no host, no absolute path), so equal objects are equal
bytes. An object is complete when its object.json is there: its folder is written beside its place and renamed into it.
So two runs in one place do no harm: the first complete folder stays, unfinished ones carry the name of their process.
"""

import hashlib
import io
import json
import os
import re
import shutil
import socket
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from spnr_jax.errors import UserError
from spnr_jax.formats.array_files import pack_arrays

SCHEMA_VERSION = 1
LAST_FILE = "object.json"  # its presence makes an object complete
UNFINISHED = ".unfinished-"  # prefix of what is still being written: .unfinished-HOST-PROCESS-SUFFIX
STALE = 24 * 3600  # seconds after which unfinished work of another host is taken for abandoned
SPLITS = ("train", "val", "test")
POINT_FIELDS = (*"xyz", "nx", "ny", "nz", "base_color_r", "base_color_g", "base_color_b", "roughness", "metallic")
POINT_TYPE = np.dtype([(name, "<f4") for name in POINT_FIELDS] + [("face", "<i4")])
POINT_PROPERTIES = [*(f"property float {name}" for name in POINT_FIELDS), "property int face"]  # POINT_TYPE in a PLY


@dataclass(frozen=True, kw_only=True)
class ObjectRecord:
    """One object as it lies on disk.

    points: POINT_TYPE (points,); transforms: the dict of transforms.json; images, conditions: (views, height, width, 4)
    uint8; details: the dict of object.json; lights: (views, 32, 64, 3) where each view has its own.
    """

    points: np.ndarray
    transforms: dict
    images: np.ndarray
    conditions: np.ndarray
    details: dict
    lights: np.ndarray | None = None


def pack_points(surface) -> np.ndarray:
    """Sampled surface points (`SurfacePoints`) as one array of POINT_TYPE (points,)."""
    columns = [surface.positions, surface.normals, surface.base_color, surface.roughness, surface.metallic]
    packed = np.empty(len(surface.positions), POINT_TYPE)
    for name, column in zip(POINT_FIELDS, np.column_stack(columns).T, strict=True):
        packed[name] = column
    packed["face"] = surface.face
    return packed


def nerf_transforms(cam_to_world: np.ndarray, resolution: int, fov: float, focal_length: float) -> dict:
    """Transforms.json for cameras (views, 4, 4): NeRF's convention, with nerfstudio's intrinsics."""
    return {
        "camera_model": "OPENCV",
        "camera_angle_x": float(np.radians(fov)),
        "fl_x": float(focal_length),
        "fl_y": float(focal_length),
        "cx": resolution / 2,
        "cy": resolution / 2,
        "w": resolution,
        "h": resolution,
        "frames": [
            {"file_path": f"images/{view:03d}.png", "transform_matrix": matrix.tolist()}
            for view, matrix in enumerate(cam_to_world)
        ],
    }


def has_object(dataset: Path, object_id: str) -> bool:
    """Whether an object of the data set is complete."""
    return (dataset / "objects" / object_id / LAST_FILE).is_file()


def list_completed(dataset: Path) -> set[str]:
    """The ids of the objects whose folders are complete."""
    places = (dataset / "objects").glob(f"*/{LAST_FILE}")
    return {place.parent.name for place in places if not place.parent.name.startswith(UNFINISHED)}


def write_object(dataset: Path, object_id: str, record: ObjectRecord) -> None:
    """Write an object's folder beside its place and rename it; if another writer was faster, its folder stays."""
    place, files = dataset / "objects" / object_id, object_files(record)
    place.parent.mkdir(parents=True, exist_ok=True)
    owner = f"{UNFINISHED}{socket.gethostname()}-{os.getpid()}-"
    beside = Path(tempfile.mkdtemp(prefix=owner, dir=place.parent))
    try:
        for name, content in files.items():
            (beside / name).parent.mkdir(exist_ok=True)
            (beside / name).write_bytes(content)
        beside.chmod(0o755)
        try:
            beside.rename(place)
        except OSError:  # a folder that is not empty is never replaced
            if not place.is_dir():
                raise
            if not (place / LAST_FILE).is_file():
                raise UserError(f"{place} is in the way: a folder without {LAST_FILE}; remove it") from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def remove_unfinished(dataset: Path) -> None:
    """Remove the objects that dead processes of this host, or any process a day ago, left half written."""
    for path in (dataset / "objects").glob(UNFINISHED + "*"):
        if is_abandoned(path):
            shutil.rmtree(path, ignore_errors=True)


def is_abandoned(path: Path) -> bool:
    """Whether nobody writes an unfinished folder any more."""
    owner = re.fullmatch(re.escape(UNFINISHED) + r"(.+)-(\d+)-\w+", path.name)
    try:
        if owner and owner[1] == socket.gethostname():
            os.kill(int(owner[2]), 0)  # asks whether the process lives
            return False
        return time.time() - path.stat().st_mtime > STALE
    except ProcessLookupError:
        return True
    except (PermissionError, FileNotFoundError):  # somebody else's process; its writer has just finished it
        return False


def object_files(record: ObjectRecord) -> dict[str, bytes]:
    """The files of one object by their paths in its folder, object.json with the others' checksums last."""
    files = {
        "points.ply": encode_points(record.points),
        "transforms.json": json_text(record.transforms).encode(),
        **{f"images/{view:03d}.png": encode_image(pixels) for view, pixels in enumerate(record.images)},
        **{f"conditions/{view:03d}.png": encode_image(pixels) for view, pixels in enumerate(record.conditions)},
    }
    if record.lights is not None:
        files["lights.npz"] = encode_lights(record.lights)
    checksums = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    return {**files, LAST_FILE: json_text({**record.details, "files": checksums}).encode()}


def encode_points(points: np.ndarray) -> bytes:
    """A POINT_TYPE array as a binary little-endian PLY of vertices."""
    size = f"element vertex {len(points)}"
    header = ["ply", "format binary_little_endian 1.0", size, *POINT_PROPERTIES, "end_header"]
    return ("\n".join(header) + "\n").encode("ascii") + points.tobytes()


def encode_image(pixels: np.ndarray) -> bytes:
    """(height, width, 4) uint8 as a PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels, "RGBA").save(buffer, "PNG")
    return buffer.getvalue()


def encode_lights(lights: np.ndarray) -> bytes:
    """Environment maps (views, height, width, 3) as an .npz of halves, cut where they are too bright."""
    halves = np.minimum(lights, np.finfo(np.float16).max).astype(np.float16)
    return pack_arrays({"lights": halves}, compressed=True)


def json_text(content) -> str:
    """The content as indented JSON with sorted keys; a number that is not finite is an error."""
    return json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n"
