"""The files of a data set: how each is written, and how it is read back.

    DATASET/dataset.json, splits/{train,val,test}.txt, rejected.jsonl
    DATASET/objects/ID/{points.ply, transforms.json, images/000.png, conditions/000.png, object.json}

Everything written is a function of its content alone (no clock, no host, no absolute path), so equal objects are equal
bytes. An object's folder is written beside its place and renamed into it: it is there complete, or not at all.
"""

import hashlib
import json
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

SCHEMA_VERSION = 1
SPLITS = ("train", "val", "test")
POINT_FIELDS = (
    "x",
    "y",
    "z",
    "nx",
    "ny",
    "nz",
    "base_color_r",
    "base_color_g",
    "base_color_b",
    "roughness",
    "metallic",
)
POINT_TYPE = np.dtype([(name, "<f4") for name in POINT_FIELDS] + [("face", "<i4")])
POINT_PROPERTIES = [*(f"property float {name}" for name in POINT_FIELDS), "property int face"]  # POINT_TYPE in a PLY
UNFINISHED = ".unfinished-"  # prefix of folders that are still being written


@dataclass(frozen=True, kw_only=True)
class ObjectRecord:
    """One object as it lies on disk.

    points: POINT_TYPE (points,); transforms: the dict of transforms.json; images, conditions: (views, height, width, 4)
    uint8; details: the dict of object.json.
    """

    points: np.ndarray
    transforms: dict
    images: np.ndarray
    conditions: np.ndarray
    details: dict


def pack_points(surface) -> np.ndarray:
    """Return sampled surface points (`points.SurfacePoints`) as one array of POINT_TYPE (points,)."""
    columns = [surface.positions, surface.normals, surface.base_color, surface.roughness, surface.metallic]
    packed = np.empty(len(surface.positions), POINT_TYPE)
    for name, column in zip(POINT_FIELDS, np.column_stack(columns).T, strict=True):
        packed[name] = column
    packed["face"] = surface.face
    return packed


def point_columns(points: np.ndarray, *names: str) -> np.ndarray:
    """Return the named fields of a POINT_TYPE array as (points, len(names)) float64."""
    return np.stack([points[name] for name in names], axis=-1).astype(np.float64)


def nerf_transforms(cam_to_world: np.ndarray, resolution: int, fov: float, focal_length: float) -> dict:
    """Return transforms.json for cameras (views, 4, 4): NeRF's convention, with nerfstudio's intrinsics."""
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


def write_object(dataset: Path, object_id: str, record: ObjectRecord) -> None:
    """Write an object's folder, complete or not at all; a complete one that is already there is left as it is."""
    objects = dataset / "objects"
    objects.mkdir(parents=True, exist_ok=True)
    place = objects / object_id
    unfinished = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=objects))
    try:
        write_object_files(unfinished, record)
        unfinished.chmod(0o755)
        if not place.exists():
            unfinished.rename(place)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def write_object_files(folder: Path, record: ObjectRecord) -> None:
    """Write the files of one object into an empty folder, object.json with their checksums last."""
    write_points(folder / "points.ply", record.points)
    (folder / "transforms.json").write_text(json_text(record.transforms))
    for name in ("images", "conditions"):
        (folder / name).mkdir()
        for view, pixels in enumerate(getattr(record, name)):
            Image.fromarray(pixels, "RGBA").save(folder / name / f"{view:03d}.png")
    (folder / "object.json").write_text(json_text({**record.details, "files": file_checksums(folder)}))


def read_object(folder: Path) -> ObjectRecord:
    """Return the object in a folder; ValueError or OSError if a file is missing or damaged."""
    transforms = json.loads((folder / "transforms.json").read_text())
    names = [Path(frame["file_path"]).name for frame in transforms["frames"]]
    return ObjectRecord(
        points=read_points(folder / "points.ply"),
        transforms=transforms,
        images=np.stack([read_image(folder / "images" / name) for name in names]),
        conditions=np.stack([read_image(folder / "conditions" / name) for name in names]),
        details=json.loads((folder / "object.json").read_text()),
    )


def write_points(path: Path, points: np.ndarray) -> None:
    """Write a POINT_TYPE array as a binary little-endian PLY of vertices."""
    size = f"element vertex {len(points)}"
    header = ["ply", "format binary_little_endian 1.0", size, *POINT_PROPERTIES, "end_header"]
    path.write_bytes(("\n".join(header) + "\n").encode("ascii") + points.tobytes())


def read_points(path: Path) -> np.ndarray:
    """Return the POINT_TYPE array (points,) of a file that `write_points` wrote; ValueError for any other file."""
    header, separator, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii", "replace").splitlines()
    if not separator or lines[1:2] != ["format binary_little_endian 1.0"] or lines[3:] != POINT_PROPERTIES:
        raise ValueError(f"{path}: not a points.ply of this data set (another header); generate the object again")
    count = int(lines[2].split()[-1])
    if len(body) != count * POINT_TYPE.itemsize:
        raise ValueError(f"{path}: expected {count} points, found {len(body) / POINT_TYPE.itemsize:g}; file is cut off")
    return np.frombuffer(body, POINT_TYPE).copy()


def read_image(path: Path) -> np.ndarray:
    """Return an RGBA PNG as (height, width, 4) uint8; ValueError if it is damaged or of another kind."""
    try:
        with Image.open(path) as image:
            image.load()
            if image.mode != "RGBA":
                raise ValueError(f"{path}: expected an RGBA image, got {image.mode}")
            return np.array(image)
    except (OSError, SyntaxError) as error:  # Pillow reports a damaged PNG as either
        raise ValueError(f"{path}: not a readable PNG ({error})") from None


def file_checksums(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file in the folder but object.json, by its path in there."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "object.json")
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def completed_objects(dataset: Path) -> set[str]:
    """Return the ids of the objects whose folders are complete."""
    objects = dataset / "objects"
    return {path.name for path in objects.iterdir() if not path.name.startswith(".")} if objects.is_dir() else set()


def remove_unfinished(dataset: Path) -> None:
    """Remove the folders that an earlier, interrupted run left half written."""
    for path in (dataset / "objects").glob(UNFINISHED + "*"):
        shutil.rmtree(path, ignore_errors=True)


def read_split(dataset: Path, split: str) -> list[str]:
    """Return the object ids of one split."""
    return (dataset / "splits" / f"{split}.txt").read_text().split()


def write_text(path: Path, text: str) -> None:
    """Write a text file in one piece: a reader sees the old content or the new, never half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(UNFINISHED + path.name)
    unfinished.write_text(text)
    os.replace(unfinished, path)


def json_text(content) -> str:
    """Return the content as indented JSON with sorted keys; a number that is not finite is an error."""
    return json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n"
