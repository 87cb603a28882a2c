"""Point clouds from files, and the few operations that a cloud needs before a network sees it.

`read_cloud` makes a PointCloud of NumPy float32 arrays, not padded, in the file's own units, turned so that y is up.
Files of points are read as named columns (spnr_jax/point_files.py); meshes are sampled uniformly by area, with their
materials.  Meaning of the columns:

    x y z                                             position
    base_color_r/g/b                                  base colour, linear
    red green blue | r g b | diffuse_red ...          colour, sRGB
    roughness, metallic | metalness                   in [0, 1]

Colours are 0..1, or 0..255: unsigned integers by their type, other numbers by their size.  What a file does not say is
grey 0.5, roughness 0.5, metallic 0; `report` is told so, and of every other assumption, one line each.
"""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.colors import srgb_to_linear
from spnr_jax.point_files import READERS, Columns, parse_ply, read_columns, read_ply_header
from spnr_jax.types import PointCloud

MESHES = (".glb", ".gltf", ".obj", ".stl", ".off")
LINEAR_NAMES = ("base_color_r", "base_color_g", "base_color_b")
SRGB_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
SCALAR_NAMES = {"roughness": ("roughness",), "metallic": ("metallic", "metalness")}
DEFAULTS = {"base_color": 0.5, "roughness": 0.5, "metallic": 0.0}
ROUNDING = 1e-4  # values this far outside [0, 1] are taken for rounded ones
MESH_POINTS = 4096  # points drawn from a mesh if no number is asked for; the most that training draws
THINNING = 16  # farthest-point sampling starts from at most this many times the points that it keeps
COARSEST_STEP = 1e-3  # of the extent, that rounding to float32 may cost
SMALLEST_BUCKET = 512
UP = {  # axis of the file that points up -> rotation (rows) that makes it y
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}


def read_cloud(
    path: str | Path,
    *,
    num_points: int | None = None,
    up: str = "y",
    seed: int = 0,
    report: Callable[[str], None] = lambda line: None,
) -> PointCloud:
    """The cloud in a file of points or on a mesh file's surface: (points, ...) float32, `mask` all True.

    More than `num_points` are thinned out evenly, fewer are kept; a mesh gives exactly `num_points` (4096 if None).
    `up` is the file's upward axis.  ValueError, one line that names the file, for whatever cannot be read.
    """
    path = Path(path)
    if up not in UP:
        raise ValueError(f"up must be one of {', '.join(UP)}, got {up!r}")
    if num_points is not None and num_points < 1:
        raise ValueError(f"num_points must be at least 1, got {num_points}")
    _check_file(path)
    try:
        if _is_mesh(path):
            positions, materials = _sampled_mesh(path, num_points or MESH_POINTS, seed, report)
        else:
            positions, materials = _points_of_columns(read_columns(path), report)
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: {str(error).splitlines()[0]}") from error
    if num_points is not None and len(positions) > num_points:
        report(f"{num_points} of {len(positions)} points kept, evenly spread")
        kept = farthest_points(positions, num_points, seed)
        positions, materials = positions[kept], {name: values[kept] for name, values in materials.items()}
    return _float32(positions @ np.array(UP[up], np.float64).T, materials)


def cloud_of_ply(content: bytes) -> PointCloud:
    """The cloud in the bytes of a PLY file of points, y up: (points, ...) float32; ValueError says what is wrong."""
    return _float32(*_points_of_columns(parse_ply(content), report=lambda line: None))


def _float32(positions: np.ndarray, materials: dict[str, np.ndarray]) -> PointCloud:
    return PointCloud(
        positions=positions.astype(np.float32),
        **{name: values.astype(np.float32) for name, values in materials.items()},
        mask=np.ones(len(positions), bool),
    )


def pad(cloud: PointCloud, size: int) -> PointCloud:
    """The cloud (points, ...) with zeros behind it up to `size` points, for which `mask` is False."""
    missing = size - len(cloud.mask)
    if missing < 0:
        raise ValueError(f"a cloud of {len(cloud.mask)} points does not fit into {size}; thin it out first")

    def extend(values):
        return np.concatenate([values, np.zeros((missing, *values.shape[1:]), values.dtype)])

    return jax.tree.map(extend, cloud)


def bucket(count: int) -> int:
    """The smallest of 512, 1024, 2048, ... that holds `count` points: few sizes, so few compilations."""
    if count < 1:
        raise ValueError(f"a cloud needs at least 1 point, got {count}")
    return max(SMALLEST_BUCKET, 1 << (count - 1).bit_length())


def normalization(positions: np.ndarray) -> tuple[np.ndarray, np.float32]:
    """(centre (3,), scale ()): (positions - centre) * scale has its bounding box around 0, with half diagonal 1.

    The scale of points without extent is 1.
    """
    low, high = (np.asarray(bound, np.float64) for bound in (positions.min(axis=0), positions.max(axis=0)))
    diagonal = np.linalg.norm(high - low)
    return ((low + high) / 2).astype(np.float32), np.float32(2 / diagonal if diagonal > 0 else 1)


def farthest_points(positions: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Sorted indices (count,) of points (n, 3), each in turn the farthest from those before; n >= count.

    Beyond THINNING * count points a random choice goes first, which bounds the time by count^2.
    """
    rng = np.random.default_rng(seed)
    candidates = np.arange(len(positions))
    if len(candidates) > THINNING * count:
        candidates = rng.choice(len(candidates), THINNING * count, replace=False)
    x, y, z = np.ascontiguousarray((positions[candidates] - positions.mean(axis=0)).T, np.float32)
    squared = np.full(len(candidates), np.inf, np.float32)
    chosen = np.empty(count, np.int64)
    chosen[0] = rng.integers(len(candidates))
    for step in range(1, count):
        last = chosen[step - 1]
        np.minimum(squared, (x - x[last]) ** 2 + (y - y[last]) ** 2 + (z - z[last]) ** 2, out=squared)
        squared[last] = -1  # never again, not even where points coincide
        chosen[step] = np.argmax(squared)
    return np.sort(candidates[chosen])


def _check_file(path: Path) -> None:
    """ValueError unless there is a file of a known kind with something in it."""
    known = tuple(dict.fromkeys((*READERS, *MESHES)))
    if path.suffix.lower() not in known:
        raise ValueError(f"{path}: unknown kind of file {path.suffix!r}; expected one of {' '.join(known)}")
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: the file is empty")


def _is_mesh(path: Path) -> bool:
    suffix = path.suffix.lower()
    return suffix in MESHES or (suffix == ".ply" and read_ply_header(path).is_mesh)


def _sampled_mesh(path: Path, count: int, seed: int, report: Callable[[str], None]):
    """Positions (count, 3) float64 and materials on a mesh's surface."""
    from data_gen.meshes import load_mesh  # only here: everything else of the package does without data_gen
    from data_gen.points import sample_surface

    asset = load_mesh(path)
    for feature in asset.ignored:
        report(f"ignored: {feature}")
    points = sample_surface(asset, count, seed)
    report(f"{count} points drawn from the surface of the mesh")
    return points.positions.astype(np.float64), {name: getattr(points, name) for name in DEFAULTS}


def _points_of_columns(columns: Columns, report: Callable[[str], None]):
    """Positions (points, 3) float64 and materials of named columns; ValueError where they are not usable."""
    if columns and not {"x", "y", "z"} <= columns.keys():
        raise ValueError(f"needs the properties x y z; found {' '.join(columns)}")
    if not columns or len(columns["x"]) == 0:
        raise ValueError("holds 0 points")
    positions = np.stack([np.asarray(columns[axis], np.float64) for axis in "xyz"], axis=-1)
    broken = np.flatnonzero(~(np.abs(positions) < np.finfo(np.float32).max).all(axis=-1))
    if broken.size:
        raise ValueError(
            f"holds {broken.size} points with NaN, infinity or too large a number, first point {broken[0]}"
        )
    _check_resolution(positions)
    materials = {"base_color": _base_color(columns, report)}
    for name, names in SCALAR_NAMES.items():
        found = next((columns[candidate] for candidate in names if candidate in columns), None)
        materials[name] = None if found is None else _unit_interval(np.asarray(found, np.float64), name)
    for name, values in materials.items():
        if values is None:
            report(f"no {name} in the file: {DEFAULTS[name]:g} taken for all points")
            materials[name] = np.full((len(positions), 3) if name == "base_color" else len(positions), DEFAULTS[name])
    return positions, materials


def _check_resolution(positions: np.ndarray) -> None:
    """ValueError if float32 would round the points together, as with map coordinates far from their origin."""
    extent, step = np.ptp(positions, axis=0).max(), np.spacing(np.float32(np.abs(positions).max()))
    if step > COARSEST_STEP * extent > 0:
        raise ValueError(
            f"holds points {step:g} apart at best in float32, for an extent of {extent:g}; move them to the origin"
        )


def _base_color(columns: Columns, report: Callable[[str], None]) -> np.ndarray | None:
    """Linear base colours (points, 3) from the columns that hold some, None if there are none."""
    for names in (LINEAR_NAMES, *SRGB_NAMES):
        if not set(names) <= columns.keys():
            continue
        channels = np.stack([columns[name] for name in names], axis=-1)
        white = _white_level(channels, linear=names == LINEAR_NAMES)
        colors = _unit_interval(channels / white, " ".join(names))
        if names == LINEAR_NAMES:
            return colors
        report(f"{' '.join(names)} taken as sRGB in 0..{white:g}")
        return np.asarray(srgb_to_linear(jnp.asarray(colors, jnp.float32)))
    return None


def _white_level(channels: np.ndarray, linear: bool) -> float:
    """The value that means full: the largest of an 8 or 16 bit type, else 1, or 255 for sRGB values that exceed 1."""
    if channels.dtype.kind == "u" and channels.dtype.itemsize <= 2:
        return float(np.iinfo(channels.dtype).max)
    highest = channels.max()
    if linear or highest <= 1 + ROUNDING:
        return 1.0
    if highest < 2:
        raise ValueError(f"has colours up to {highest:g}: neither 0 to 1 nor 0 to 255")
    return 255.0


def _unit_interval(values: np.ndarray, name: str) -> np.ndarray:
    """The values, rounding errors removed; ValueError if they are not in [0, 1]."""
    low, high = values.min(), values.max()
    if not (low >= -ROUNDING and high <= 1 + ROUNDING):
        raise ValueError(f"has {name} from {low:g} to {high:g}; expected 0 to 1 (colours: or 0 to 255)")
    return np.clip(values, 0, 1)
