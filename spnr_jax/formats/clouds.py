"""Point clouds from files of points and of meshes, on one path.

    open        columns with the file's names, positions in float64 (point_files.py, meshes.py)
    interpret   colours, materials, normals, opacity, classes (columns.py, orientation.py)
    cut         to a box; remove the dominant plane; keep one cluster
    merge       equal and nearly equal points; refuse what is no surface then
    clean, thin remove outliers and noise; keep evenly spread points
    origin      subtract it where float32 is too coarse; then convert to float32

`read_cloud` returns a PointCloud of NumPy float32 arrays, not padded, in the file's units, rotated so that y is up.
`place_cloud` also returns the transform back to the file's frame.  Point files may be larger than the memory.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np

from spnr_jax.config import Cut
from spnr_jax.errors import UserError
from spnr_jax.formats.assets import Asset, ShownParts
from spnr_jax.formats.columns import (
    DEFAULTS,
    LINEAR,
    NORMAL,
    POSITION,
    Columns,
    Report,
    describe_use,
    keep_visible,
    materials,
    normals,
    sound,
    useful,
)
from spnr_jax.formats.orientation import ROTATIONS, find_up, holds_splats, sensor_of
from spnr_jax.formats.plausibility import check_rounding, check_steps, check_values, drop_no_data
from spnr_jax.formats.point_files import MESHES, column_pieces, kind_of, parse_ply
from spnr_jax.formats.surface_points import SurfacePoints, bounding_box, sample_surface, vertex_points
from spnr_jax.kernels import cloud_arrays, scenes
from spnr_jax.kernels.cleaning import Clean, clean_columns
from spnr_jax.kernels.cloud_arrays import inner_box, stack_columns
from spnr_jax.kernels.records import PointCloud
from spnr_jax.surfels.normals import face_sensor, outward_normals

__all__ = ("MESHES", "PlacedCloud", "cloud_of_ply", "place_cloud", "read_cloud")

MESH_POINTS = 4096  # points sampled on a mesh by default: the most that training samples
MOST_EVEN = 2**14  # points that are spread evenly over a mesh, in seconds; more are drawn at random
CAPACITY = 2**19  # points in memory; a random sample of larger files is kept while reading
BROKEN = "NaN, infinity or too large a number"
TEXT_MESHES = (".obj", ".off")  # numbers with any number of digits
CUT_MESH = 2**18  # points sampled on a mesh before a part of it is cut out
WHOLE = Cut()
COARSEST_STEP = 2e-5  # of the extent: largest error of rounding to float32
FEWEST = 10  # points from which a surface can be estimated


@dataclass(frozen=True, kw_only=True)
class PlacedCloud:
    """A cloud, y up, and its transform to the file's frame: position in the file = rotation.T @ position + origin."""

    cloud: PointCloud
    up: str
    rotation: np.ndarray  # (3, 3): file -> y up
    origin: np.ndarray  # (3,) float64, 0 unless float32 is too coarse there


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Options of reading a file; ValueError for unknown values."""

    num_points: int | None = None  # larger clouds are thinned evenly; samples on a mesh (default 4096)
    up: str = "auto"  # the file's upward axis
    seed: int = 0
    clean: Clean = "off"  # how point files, not meshes, are cleaned before thinning (kernels/cleaning.py)
    cut: Cut = WHOLE  # the part of the scene to keep
    transparent_parts: ShownParts = "opaque"  # of a mesh, or "skip" to leave them out
    report: Report = lambda line: None  # called with a line about every assumption

    def __post_init__(self) -> None:
        """ValueError names the invalid option."""
        choices = {"up": (*ROTATIONS, "auto"), "transparent_parts": get_args(ShownParts), "clean": get_args(Clean)}
        for name, known in choices.items():
            if (value := getattr(self, name)) not in known:
                raise UserError(f"{name} must be one of {', '.join(known)}, got {value!r}")
        for name, value, least in (("num_points", self.num_points, 1), ("seed", self.seed, 0)):
            if value is not None and not (isinstance(value, int | np.integer) and value >= least):
                raise UserError(f"{name} must be a whole number of at least {least}, got {value}")


def read_cloud(
    path: str | Path,
    *,
    num_points: int | None = None,
    up: str = "y",
    seed: int = 0,
    clean: Clean = "off",
    cut: Cut = WHOLE,
    transparent_parts: ShownParts = "opaque",
    report: Report = lambda line: None,
) -> PointCloud:
    """The cloud of a point file, or sampled on the surface of a mesh file: (points, ...) float32, `mask` all True.

    The options are those of `Reading`.  A thinned cloud has normals: the file's, or estimated from all of its points
    (surfels/normals.py).  ValueError, one line that names the file, if it cannot be read.
    """
    how = {"seed": seed, "clean": clean, "cut": cut, "transparent_parts": transparent_parts, "report": report}
    return place_cloud(path, num_points=num_points, up=up, **how).cloud


def place_cloud(path: str | Path, **options: Any) -> PlacedCloud:
    """The cloud of `read_cloud` with its transform to the file's frame."""
    path, how = Path(path), Reading(**options)
    kind = kind_of(path)
    try:
        with np.errstate(all="ignore"):  # signalling NaN and overflow: both are checked for
            points, noise = _points_of(path, kind, how)
            return _place(path, kind, points, noise, how)
    except (ValueError, OSError) as error:
        raise UserError(f"{path}: {str(error).splitlines()[0]}") from error


class Points(NamedTuple):
    """Positions (points, 3) float64 in the file's axes minus `origin`, and the other columns by name."""

    positions: np.ndarray
    values: dict[str, np.ndarray]
    origin: np.ndarray

    def take(self, rows: np.ndarray) -> "Points":
        """The points of these rows."""
        return Points(self.positions[rows], {name: column[rows] for name, column in self.values.items()}, self.origin)


def _points_of(path: Path, kind: str, how: Reading) -> tuple[Points, float]:
    """The points of a file, read, cut and cleaned, and their noise level."""
    pieces, sampled, noise, cut = column_pieces(path, kind, how.report), False, 0.0, how.cut
    if pieces is None:
        columns, sampled = _mesh_columns(path, kind, how)
        pieces = iter([columns])
    points = _interpret(_read_columns(pieces, how), sampled, how)
    rows, lines = scenes.select_object(points.positions, points.origin, cut.remove_plane, cut.nth, how.seed)
    points = points.take(rows)
    if not sampled and how.clean != "off":
        positions, values, done, noise = clean_columns(points.positions, points.values, how.clean)
        points, lines = Points(positions, values, points.origin), lines + done
    for line in lines:
        how.report(line)
    if not sampled:
        check_values(points.positions, points.values, how.report)
    return points, noise


def _place(path: Path, kind: str, points: Points, noise: float, how: Reading) -> PlacedCloud:
    """The cloud of the points: thinned, with normals, rotated so that y is up, moved to its origin."""
    up, count, before = how.up, how.num_points, points.origin
    sensor = sensor_of(path, kind, points.positions + before, how.report)
    kept = np.arange(len(points.positions))
    if count is not None and len(kept) > count:
        how.report(f"{count} of {len(kept)} points kept, evenly spread")
        kept = np.sort(cloud_arrays.farthest_points(points.positions, count, how.seed, points.values.get("normals")))
    positions, values, _ = points.take(kept)
    if "normals" not in values and sensor:
        values["normals"] = face_sensor(positions, points.positions, sensor.place - before, noise)
        how.report("normals turned to the place of the sensor")
    elif "normals" not in values and len(kept) < len(points.positions):
        values["normals"] = outward_normals(points.positions, points.values["base_color"], kept, noise)
    if up == "auto":
        if sensor and sensor.up:
            up, reason = sensor.up, "that of its camera"
        else:
            up, reason = find_up(positions, kind, of_splats=holds_splats(path, kind))
        how.report(f"{up} taken as up ({reason}); --up says otherwise")
    rotation = np.array(ROTATIONS[up], np.float64)
    if "normals" in values:
        values["normals"] = values["normals"] @ rotation.T
    origin = _find_origin(positions + before)
    if origin.any():
        how.report(f"moved by {' '.join(f'{0 - value:.15g}' for value in origin)} to keep precision")
    cloud = _float32((positions + (before - origin)) @ rotation.T, values)
    return PlacedCloud(cloud=cloud, up=up, rotation=rotation, origin=origin)


@np.errstate(all="ignore")  # signalling NaN and overflow: both are checked for
def cloud_of_ply(content: bytes) -> PointCloud:
    """The cloud in the bytes of a PLY file of points, y up: (points, ...) float32; ValueError says what is wrong.

    For data sets, which are written by this package: a row with NaN or infinity is an error there.
    """
    columns = useful(parse_ply(content))
    broken = np.flatnonzero(~sound(columns))
    if broken.size:
        raise UserError(f"holds {broken.size} points with {BROKEN}, first point {broken[0]}")
    if not len(columns["x"]):
        raise UserError("holds 0 points")
    values, directions = materials(columns, lambda line: None), normals(columns)
    return _float32(stack_columns(columns), values if directions is None else values | {"normals": directions})


def _float32(positions: np.ndarray, values: dict[str, np.ndarray]) -> PointCloud:
    columns = {name: column.astype(np.float32) for name, column in values.items()}
    return PointCloud(positions=positions.astype(np.float32), mask=np.ones(len(positions), bool), **columns)


def _find_origin(positions: np.ndarray) -> np.ndarray:
    """Round numbers (3,) to subtract from positions (n, 3) if float32 is too coarse for them, else 0.

    They are whole for clouds of one unit and more, else multiples of the power of ten below the extent.
    """
    low, high = inner_box(positions)
    step = np.spacing(np.float32(np.maximum(np.abs(low), np.abs(high)).max()))
    extent = (high - low).max()
    if not step > COARSEST_STEP * extent > np.finfo(np.float32).tiny:
        return np.zeros(3)
    finer = 10.0 ** max(0, -np.floor(np.log10(extent)))
    return np.floor(low * finer) / finer


def _mesh_columns(path: Path, kind: str, how: Reading) -> tuple[Columns, bool]:
    """Columns of points sampled on a mesh file's surface (True), or of its vertices if it has no faces (False)."""
    from spnr_jax.formats.meshes import load_mesh  # not at the top: point files need no mesh readers

    asset, report = load_mesh(path, transparent_parts=how.transparent_parts, kind=kind), how.report
    for line in (*([f"ignored: {'; '.join(asset.ignored)}"] if asset.ignored else []), *asset.notes):
        report(line)
    sampled = any(len(part.faces) for part in asset.parts)
    points, origin = _spread(asset, kind, how) if sampled else (vertex_points(asset), 0)
    fields = [  # names, values, default value
        (POSITION, points.positions + origin, None),
        (NORMAL, points.normals, 0),
        (LINEAR, points.base_color, DEFAULTS["base_color"]),
        *(((name,), getattr(points, name), DEFAULTS[name]) for name in ("roughness", "metallic")),
    ]
    unknown = [names for names, values, default in fields if np.all(values == default)]
    if sampled and len(unknown) < len(DEFAULTS):  # some of the materials happens to equal its default
        unknown = []
    if not sampled and all(part.alpha is not None for part in asset.parts):
        fields.append((("alpha",), np.concatenate([part.alpha for part in asset.parts]), None))
    known = [(names, values.reshape(len(values), -1).T) for names, values, _ in fields if names not in unknown]
    return {name: column for names, columns in known for name, column in zip(names, columns, strict=True)}, sampled


def _spread(asset: Asset, kind: str, how: Reading) -> tuple[SurfacePoints, np.ndarray]:
    """Points sampled on the surface of a mesh minus an origin (3,), which is 0 unless float32 is too coarse."""
    corners, report = np.stack(bounding_box(asset)), how.report
    vertices = np.concatenate([part.positions[np.unique(part.faces)] for part in asset.parts])
    check_rounding(vertices, report, of_mesh=True)
    if kind not in TEXT_MESHES:
        short = vertices.astype(np.float32)  # were they rounded to it?  If so, several axes have all of its digits
        digits = vertices / np.spacing(np.abs(short).max(axis=0))
        rounded = (vertices == short).all() and (digits % 2 == 1).any(axis=0).sum() > 1
        check_steps(vertices, (short if rounded else vertices).T, report)
    if (origin := _find_origin(corners)).any():  # before anything is converted to float32
        asset = replace(asset, parts=tuple(replace(part, positions=part.positions - origin) for part in asset.parts))
    count = max(CUT_MESH if how.cut.is_given else 0, how.num_points or MESH_POINTS)
    report(f"{count} points spread over the surface of the mesh")
    return sample_surface(asset, count, how.seed, "even" if count <= MOST_EVEN else "random", sides=True), origin


def _read_columns(pieces: Iterator[Columns], how: Reading) -> Columns:
    """The columns in use of a point file, inside the crop box; a random sample of very large files."""
    cut, report = how.cut, how.report
    capacity, broken, outside = max(CAPACITY, cloud_arrays.THINNING * (how.num_points or 0)), 0, 0
    low, high = np.full(3, np.inf), np.full(3, -np.inf)

    def sound_pieces() -> Iterator[Columns]:
        nonlocal broken, outside, low, high
        for number, piece in enumerate(pieces):
            for line in () if number else describe_use(piece):
                report(line)
            columns = useful(piece)
            wanted = sound(columns)
            broken += int(np.count_nonzero(~wanted))
            if cut.crop:
                positions = stack_columns(columns)
                low = np.minimum(low, positions[wanted].min(axis=0, initial=np.inf))
                high = np.maximum(high, positions[wanted].max(axis=0, initial=-np.inf))
                inside = scenes.is_inside(positions, cut.crop)
                outside += int(np.count_nonzero(wanted & ~inside))
                wanted &= inside
            yield columns if wanted.all() else {name: column[wanted] for name, column in columns.items()}

    columns, inside = cloud_arrays.sample_stream(sound_pieces(), capacity)
    if not inside + outside:
        nothing = f"no point that can be used: {BROKEN} in all of its {broken} rows" if broken else "0 points"
        raise UserError(f"holds {nothing}")
    if broken:
        report(f"{broken:,} of {inside + outside + broken:,} points left out: {BROKEN}")
    if cut.crop:
        report(scenes.describe_crop(inside, inside + outside, cut.crop, low, high))
    if inside > capacity:
        report(f"{len(columns['x'])} of {inside} points kept while reading, drawn at random")
    return columns


def _interpret(columns: Columns, sampled: bool, how: Reading) -> Points:
    """Interprets the columns; equal and nearly equal points are merged, unless they were sampled on a mesh."""
    report = how.report
    if not sampled:
        columns = drop_no_data(keep_visible(columns, how.cut.keep_noise, report), report)
    positions = stack_columns(columns)
    if not sampled:
        check_steps(positions, [columns[axis] for axis in "xyz"], report)
        check_rounding(positions, report)
    origin = _find_origin(positions)
    values, directions = materials(columns, report), normals(columns)
    if directions is not None:
        values["normals"] = directions
    elif set(NORMAL) <= columns.keys():
        report("normals of the file left out: none is a direction with a sign")
    places = positions - origin
    if not sampled:
        places, values, merged = cloud_arrays.merge_repeats(places, values)
        if merged:
            report(f"{merged:,} of {len(positions):,} points repeat others, and were merged with them")
        cloud_arrays.require_surface(places, len(positions))
    if len(places) < FEWEST:
        report(f"{len(places)} points alone tell next to no surface: the picture is a guess")
    return Points(places, values, origin)
