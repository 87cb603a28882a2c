"""Point clouds from files.

`read_cloud` makes a PointCloud of NumPy float32 arrays, not padded, in the file's own units, turned so that y is up;
`place_cloud` also says how to get back into the file's frame.  Files of points are read as named columns
(point_files.py, what they mean: point_columns.py), of any size in bounded memory; points are spread evenly over meshes.
What a file does not say is grey 0.5, roughness 0.5, metallic 0; `report` gets a line about every assumption.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.cut import Cut
from spnr_jax.formats.mesh.assets import ShownParts
from spnr_jax.formats.ply import read_ply_header
from spnr_jax.formats.point_columns import DEFAULTS, LINEAR, POSITION, SRGB, Columns, materials, normals, useful
from spnr_jax.formats.point_files import READERS, column_pieces, parse_ply
from spnr_jax.formats.sensor import sensor_of
from spnr_jax.formats.up_axis import ROTATIONS, find_up
from spnr_jax.kernels import scenes
from spnr_jax.kernels.cleaning import Clean, cleaned
from spnr_jax.kernels.facing import facing
from spnr_jax.kernels.records import PointCloud
from spnr_jax.kernels.thinning import THINNING, farthest_points, sample_stream, stacked
from spnr_jax.surfels.outward import outward_normals

MESHES = (".glb", ".gltf", ".obj", ".stl", ".off")
MESH_POINTS = 4096  # points drawn from a mesh if no number is asked for; the most that training draws
MOST_EVEN = 2**14  # points that are spread evenly over a mesh, in seconds; more lie close enough as they are drawn
CAPACITY = 2**19  # points of a file that are in memory at most; of more a random sample is kept while reading
BROKEN = "NaN, infinity or too large a number"
CUT_MESH = 2**18  # points drawn from a mesh that something is cut out of
WHOLE = Cut()
COARSEST_STEP = 1e-3  # of the extent, that rounding to float32 may cost


@dataclass(frozen=True, kw_only=True)
class PlacedCloud:
    """A cloud, y up, and its place in the file's frame: position in the file = rotation.T @ position + origin."""

    cloud: PointCloud
    up: str
    rotation: np.ndarray  # (3, 3): file -> y up
    origin: np.ndarray  # (3,) float64, 0 unless float32 is too coarse there


def read_cloud(
    path: str | Path,
    *,
    num_points: int | None = None,
    up: str = "y",
    seed: int = 0,
    clean: Clean = "off",
    cut: Cut = WHOLE,
    transparent_parts: ShownParts = "opaque",
    report: Callable[[str], None] = lambda line: None,
) -> PointCloud:
    """The cloud in a file of points or on a mesh file's surface: (points, ...) float32, `mask` all True.

    More than `num_points` are thinned out evenly, fewer are kept; a mesh gives exactly `num_points` (4096 if None).
    `up` is the file's upward axis, or "auto".  Unless `clean` is "off" points are cleaned before they are thinned
    (spnr_jax/kernels/cleaning.py), those of meshes never; of a file of more than CAPACITY, a random sample of these.
    Points that are thinned out have normals, the file's or those that all of its points tell (surfels/outward.py).
    `cut` says which part of a scene is wanted.  Rows without finite numbers are left out.  Transparent parts of a mesh
    are taken as opaque, or left out ("skip").  ValueError, one line that names the file, for whatever cannot be read.
    """
    return place_cloud(
        path,
        num_points=num_points,
        up=up,
        seed=seed,
        clean=clean,
        cut=cut,
        transparent_parts=transparent_parts,
        report=report,
    ).cloud


def place_cloud(
    path: str | Path,
    *,
    num_points: int | None = None,
    up: str = "auto",
    seed: int = 0,
    clean: Clean = "off",
    cut: Cut = WHOLE,
    transparent_parts: ShownParts = "opaque",
    report: Callable[[str], None] = lambda line: None,
) -> PlacedCloud:
    """The cloud of `read_cloud` with the way back into the file's frame."""
    path = Path(path)
    if up not in (*ROTATIONS, "auto"):
        raise UserError(f"up must be one of {', '.join(ROTATIONS)}, auto, got {up!r}")
    if num_points is not None and num_points < 1:
        raise UserError(f"num_points must be at least 1, got {num_points}")
    if transparent_parts not in get_args(ShownParts):
        raise UserError(f"transparent_parts must be opaque or skip, got {transparent_parts!r}")
    if clean not in get_args(Clean):
        raise UserError(f"clean must be one of {', '.join(get_args(Clean))}, got {clean!r}")
    _check_file(path)
    try:
        positions, origin, values, sensor, sigma = _read(path, num_points, seed, clean, cut, transparent_parts, report)
    except (ValueError, OSError) as error:
        raise UserError(f"{path}: {str(error).splitlines()[0]}") from error
    kept = np.arange(len(positions))
    if num_points is not None and len(positions) > num_points:
        report(f"{num_points} of {len(positions)} points kept, evenly spread")
        kept = np.sort(farthest_points(positions, num_points, seed))
    all_colors, values = values["base_color"], {name: column[kept] for name, column in values.items()}
    if "normals" not in values and sensor:
        values["normals"] = facing(positions[kept], positions, sensor.place - origin, sigma)
        report("normals turned to the place of the sensor")
    elif "normals" not in values and len(kept) < len(positions):
        values["normals"] = outward_normals(positions, all_colors, kept, sigma)
    positions = positions[kept]
    if up == "auto":
        camera_up = sensor.up(positions + origin) if sensor else None
        up, reason = (camera_up, "that of its camera") if camera_up else find_up(positions, path)
        report(f"{up} taken as up ({reason}); --up says otherwise")
    rotation = np.array(ROTATIONS[up], np.float64)
    if "normals" in values:
        values["normals"] = values["normals"] @ rotation.T
    return PlacedCloud(cloud=_float32(positions @ rotation.T, values), up=up, rotation=rotation, origin=origin)


@np.errstate(all="ignore")  # of signalling NaN, and what leaves its type: both are looked for
def cloud_of_ply(content: bytes) -> PointCloud:
    """The cloud in the bytes of a PLY file of points, y up: (points, ...) float32; ValueError says what is wrong.

    It is for data sets, which were written whole: a row without finite numbers is a fault there.
    """
    positions, _, values = _points_of_columns(_all_sound(useful(parse_ply(content))), report=lambda line: None)
    return _float32(positions, values)


def _float32(positions: np.ndarray, values: dict[str, np.ndarray]) -> PointCloud:
    return PointCloud(
        positions=positions.astype(np.float32),
        **{name: column.astype(np.float32) for name, column in values.items()},
        mask=np.ones(len(positions), bool),
    )


def _check_file(path: Path) -> None:
    """ValueError unless there is a file of a known kind with something in it."""
    known = tuple(dict.fromkeys((*READERS, *MESHES)))
    if path.is_dir():
        raise UserError(f"{path}: a folder; expected a file of one of {' '.join(known)}")
    if path.suffix.lower() not in known:
        raise UserError(f"{path}: unknown kind of file {path.suffix!r}; expected one of {' '.join(known)}")
    if not path.is_file():
        raise UserError(f"{path}: there is no such file")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: the file is empty")


def _is_mesh(path: Path) -> bool:
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in MESHES
    with path.open("rb") as file:
        return read_ply_header(file).is_mesh


@np.errstate(all="ignore")  # of signalling NaN, and what leaves its type: both are looked for
def _read(
    path: Path,
    num_points: int | None,
    seed: int,
    clean: Clean,
    cut: Cut,
    transparent_parts: ShownParts,
    report: Callable[[str], None],
):
    """Positions (points, 3) float64 of what is cut out of a file, cleaned; their origin, materials, sensor, noise."""
    mesh = _is_mesh(path)
    if mesh:
        count = max(CUT_MESH if cut.asked else 0, num_points or MESH_POINTS)
        positions, origin, values = _sampled_mesh(path, count, seed, transparent_parts, report)
        if cut.crop:
            inside = scenes.in_box(positions, cut.crop)
            report(scenes.cropped(int(inside.sum()), count, cut.crop, positions.min(axis=0), positions.max(axis=0)))
            positions, values = positions[inside], {name: column[inside] for name, column in values.items()}
    else:
        columns = _bounded_columns(path, num_points, cut, report)
        positions, origin, values = _points_of_columns(columns, report)
    rows, lines = scenes.object_of(positions, origin, cut.remove_plane, cut.nth, seed)
    positions, values = positions[rows], {name: column[rows] for name, column in values.items()}
    sigma = 0.0
    if not mesh and clean != "off":
        positions, values, done, sigma = cleaned(positions, values, clean)
        lines += done
    for line in lines:
        report(line)
    return positions, origin, values, sensor_of(path, positions + origin), sigma


def _sampled_mesh(path: Path, count: int, seed: int, transparent_parts: ShownParts, report: Callable[[str], None]):
    """Positions (count, 3) float64, their origin (3,), materials and normals of points spread evenly over a mesh."""
    from spnr_jax.formats.mesh.meshes import load_mesh  # here: points are read without trimesh
    from spnr_jax.formats.mesh.surface_points import sample_surface

    asset = load_mesh(path, transparent_parts=transparent_parts)
    if asset.ignored:
        report(f"ignored: {'; '.join(asset.ignored)}")
    for note in asset.notes:
        report(note)
    points = sample_surface(asset, count, seed, "even" if count <= MOST_EVEN else "random")
    if not np.isfinite(points.positions).all():
        raise UserError(f"holds vertices too large for float32, more than {np.finfo(np.float32).max:.2g}")
    report(f"{count} points spread over the surface of the mesh")
    values = {name: getattr(points, name) for name in DEFAULTS}
    if all((values[name] == default).all() for name, default in DEFAULTS.items()):
        report("no material in the mesh: base_color 0.5, roughness 0.5, metallic 0 taken everywhere")
        values["materials_known"] = np.zeros(count)
    return points.positions.astype(np.float64), np.zeros(3), values | {"normals": points.normals}


def _bounded_columns(path: Path, num_points: int | None, cut: Cut, report: Callable[[str], None]) -> Columns:
    """The useful columns of a point file inside the box to be cut out, of very many points those of a random sample."""
    capacity, broken, outside = max(CAPACITY, THINNING * (num_points or 0)), 0, 0
    low, high = np.full(3, np.inf), np.full(3, -np.inf)

    def sound_pieces() -> Iterator[Columns]:
        nonlocal broken, outside, low, high
        for piece in column_pieces(path):
            columns = useful(piece)
            wanted = _sound(columns)
            broken += int(np.count_nonzero(~wanted))
            if cut.crop:
                positions = stacked(columns)
                low = np.minimum(low, positions[wanted].min(axis=0, initial=np.inf))
                high = np.maximum(high, positions[wanted].max(axis=0, initial=-np.inf))
                inside = scenes.in_box(positions, cut.crop)
                outside += int(np.count_nonzero(wanted & ~inside))
                wanted = wanted & inside
            yield columns if wanted.all() else {name: column[wanted] for name, column in columns.items()}

    columns, seen = sample_stream(sound_pieces(), capacity)
    if broken and not seen + outside:
        raise UserError(f"holds no point that can be used: {BROKEN} in all of its {broken} rows")
    if broken:
        report(f"{broken:,} of {seen + outside + broken:,} points left out: {BROKEN}")
    if cut.crop and seen + outside:
        report(scenes.cropped(seen, seen + outside, cut.crop, low, high))
    if seen > capacity:
        report(f"{len(columns['x'])} of {seen} points kept while reading, drawn at random")
    return columns


def _sound(columns: Columns) -> np.ndarray:
    """Mask (points,) of rows whose position and materials are numbers that float32 holds."""
    names = [name for name in (*POSITION, *LINEAR, *SRGB, *DEFAULTS) if name in columns]
    largest = np.finfo(np.float32).max
    return np.logical_and.reduce([np.abs(np.asarray(columns[name], np.float64)) < largest for name in names])


def _all_sound(columns: Columns) -> Columns:
    """The columns; ValueError if there is a row that is not sound."""
    broken = np.flatnonzero(~_sound(columns))
    if broken.size:
        raise UserError(f"holds {broken.size} points with {BROKEN}, first point {broken[0]}")
    return columns


def _points_of_columns(columns: Columns, report: Callable[[str], None]):
    """Positions (points, 3) float64, their origin (3,), materials and normals, if any, of useful columns."""
    if not columns or len(columns["x"]) == 0:
        raise UserError("holds 0 points")
    positions, origin = stacked(columns), np.zeros(3)
    extent, step = np.ptp(positions, axis=0).max(), np.spacing(np.float32(np.abs(positions).max()))
    if step > COARSEST_STEP * extent > 0:
        if columns["x"].dtype == np.float32:
            raise UserError(
                f"holds points {step:g} apart at best in float32, for an extent of {extent:g}; move them to the origin"
            )
        origin = np.floor(positions.min(axis=0))
        report(f"moved by {' '.join(f'{0 - value:.0f}' for value in origin)} to keep precision")
    values, directions = materials(columns, report), normals(columns)
    return positions - origin, origin, values if directions is None else values | {"normals": directions}
