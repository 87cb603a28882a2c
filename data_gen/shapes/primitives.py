"""Part builders: closed surfaces as pure functions of numbers, with shading normals and texture coordinates.

Idea: every builder is a grid of points, and `patch` turns a grid into triangles; nothing else makes triangles.
Conventions:
  outlines      closed, in the plane, (k, 2), counter-clockwise, without the first point repeated
  rings, rows   a grid is (rows, columns, 3); columns run counter-clockwise seen from where the rows go to, so that
                d_columns x d_rows points out of the solid and faces come out counter-clockwise seen from outside
  axes          y up; `lathe` turns about y, `prism` and `loft` of sections may go anywhere
  creases       a corner's normal averages the neighbouring cells that turn away by less than `crease` degrees, so one
                grid carries smooth and hard edges
  texcoords     in units of length (arc length along the grid, or the plane of a cap): uniform density; callers
                divide by the texture's size
"""

from typing import NamedTuple

import numpy as np


def circle(segments: int, radius=1.0) -> np.ndarray:
    """(segments, 2) points on a circle."""
    angle = 2 * np.pi * np.arange(segments) / segments
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def superellipse(segments: int, exponent: float, half=(1.0, 1.0)) -> np.ndarray:
    """(segments, 2) points with |x/a|^(2/e) + |y/b|^(2/e) = 1: e = 1 an ellipse, e < 1 squarer, e = 2 a diamond."""
    unit = np.round(circle(segments), 12)  # cos(90 degrees) is not quite 0, and small powers would show it
    return np.sign(unit) * np.abs(unit) ** exponent * np.asarray(half)


def rounded_rectangle(width: float, height: float, radius=0.0, steps=3) -> np.ndarray:
    """(4 steps + 4, 2) points of a rectangle about 0 with rounded corners; 4 points if radius is 0."""
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)], float)
    if radius <= 0:
        return corners * (width / 2, height / 2)
    angle = np.radians(90 * np.arange(4)[:, None] + np.linspace(0, 90, steps + 1))
    arcs = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return (corners[:, None] * (width / 2 - radius, height / 2 - radius) + arcs).reshape(-1, 2)


def curve(points, samples) -> np.ndarray:
    """(samples, 3 or 2) points of a Catmull-Rom curve through control points, ends included."""
    points = np.asarray(points, float)
    padded = np.concatenate([[2 * points[0] - points[1]], points, [2 * points[-1] - points[-2]]])
    place = np.linspace(0, len(points) - 1, samples)
    i = np.minimum(place.astype(int), len(points) - 2)
    t = (place - i)[:, None]
    a, b, c, d = padded[i], padded[i + 1], padded[i + 2], padded[i + 3]
    return 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)


def bent_line(points, radius: float) -> np.ndarray:
    """(k, 3) straight runs through points (n, 3), each inner corner rounded over `radius` before and after it."""
    points = np.asarray(points, float)
    path, t = [points[:1]], np.linspace(0, 1, 7)[:, None]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        back, ahead = before - corner, after - corner
        back, ahead = (arm * min(radius / np.linalg.norm(arm), 0.49) for arm in (back, ahead))
        path.append(corner + back * (1 - t) ** 2 + ahead * t**2)
    return np.concatenate([*path, points[-1:]])


def airfoil(segments: int, thickness: float) -> np.ndarray:
    """(2 segments, 2) outline of a symmetric NACA wing section of chord 1, nose at (0, 0), tail at (1, 0)."""
    x = 0.5 * (1 - np.cos(np.linspace(0, np.pi, segments + 1)))
    half = 5 * thickness * (0.2969 * np.sqrt(x) - 0.126 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1036 * x**4)
    lower, upper = np.column_stack([x, -half])[:-1], np.column_stack([x, half])[:0:-1]
    return np.concatenate([lower, upper])


CREASE = 37.3  # degrees; off the round numbers, so that no builder sits on the threshold


class Mesh(NamedTuple):
    """Triangles: positions and unit normals (v, 3), texcoords (v, 2), faces (f, 3) counter-clockwise from outside."""

    positions: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    texcoords: np.ndarray


def cross(a, b) -> np.ndarray:
    """a x b along the last axis; np.cross spends most of its time on shapes that do not occur here."""
    forward, backward = [1, 2, 0], [2, 0, 1]
    return a[..., forward] * b[..., backward] - a[..., backward] * b[..., forward]


# ---------------------------------------------------------------- grids


def patch(points, *, wrap_columns=False, wrap_rows=False, crease=CREASE, texcoords=None) -> Mesh:
    """Mesh of a grid of points (r, c, 3), each cell two triangles; a wrapped axis joins its end to its start.

    texcoords (r, c, 2), one more per wrapped axis, replaces arc length. Cells and triangles without area are left out.
    """
    points = np.asarray(points, float)
    if wrap_columns:
        points = np.concatenate([points, points[:, :1]], axis=1)
    if wrap_rows:
        points = np.concatenate([points, points[:1]], axis=0)
    texcoords = _arc_length(points) if texcoords is None else np.asarray(texcoords, float)
    corners = _cell_corners(points)
    area = 0.5 * cross(corners[2] - corners[0], corners[3] - corners[1])
    normals = _corner_normals(area, wrap_rows, wrap_columns, np.cos(np.radians(crease)))
    order = np.arange(4 * area[..., 0].size).reshape(4, -1)
    faces = np.concatenate([order[[0, 1, 2]].T, order[[0, 2, 3]].T])
    mesh = Mesh(corners.reshape(-1, 3), faces, normals.reshape(-1, 3), _cell_corners(texcoords).reshape(-1, 2))
    return _without_slivers(mesh)


def _cell_corners(grid) -> np.ndarray:
    """(4, r - 1, c - 1, k): the corners of each cell, counter-clockwise seen from outside."""
    return np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]])


def _corner_normals(area, wrap_rows, wrap_columns, least_cosine) -> np.ndarray:
    """(4, r, c, 3) unit normals of the corners of cells whose area vectors are (r, c, 3)."""
    rows, columns = area.shape[:2]
    padded = area[np.arange(-1, rows + 1) % rows][:, np.arange(-1, columns + 1) % columns]
    if not wrap_rows:
        padded[[0, -1]] = 0
    if not wrap_columns:
        padded[:, [0, -1]] = 0
    length = np.linalg.norm(padded, axis=-1, keepdims=True)
    unit = padded / np.where(length > 0, length, 1)
    own = unit[1:-1, 1:-1]

    neighbour = {}
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            window = np.s_[1 + i : 1 + i + rows, 1 + j : 1 + j + columns]
            agrees = np.einsum("rck,rck->rc", own, unit[window]) > least_cosine
            neighbour[i, j] = padded[window] * agrees[..., None]
    total = np.stack(
        [
            neighbour[0, 0] + neighbour[i, 0] + neighbour[0, j] + neighbour[i, j]
            for i, j in ((-1, -1), (-1, 1), (1, 1), (1, -1))
        ]
    )
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    return total / np.where(length > 0, length, 1)


def _arc_length(points) -> np.ndarray:
    """(r, c, 2) texture coordinates: mean distance walked along the columns, and along the rows."""
    along_columns = np.linalg.norm(np.diff(points, axis=1), axis=-1).mean(axis=0)
    along_rows = np.linalg.norm(np.diff(points, axis=0), axis=-1).mean(axis=1)
    u = np.concatenate([[0.0], np.cumsum(along_columns)])
    v = np.concatenate([[0.0], np.cumsum(along_rows)])
    return np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1)


def _without_slivers(mesh: Mesh) -> Mesh:
    """The mesh less its triangles of no area (relative to its size, also after rounding) and unused vertices."""
    a, b, c = mesh.positions[mesh.faces.T]
    sides = np.linalg.norm(np.stack([b - a, c - b, a - c]), axis=-1)
    height = np.linalg.norm(cross(b - a, c - a), axis=-1) / np.maximum(sides.max(axis=0), 1e-12)
    faces = mesh.faces[height > 2e-5]
    used = np.zeros(len(mesh.positions), bool)
    used[faces] = True
    return Mesh(mesh.positions[used], (np.cumsum(used) - 1)[faces], mesh.normals[used], mesh.texcoords[used])


def cap(ring, *, top: bool) -> Mesh:
    """Lid over a flat ring (c, 3) that its centre sees whole; `top` closes the last ring of a loft, else the first.

    Its texture coordinates are the two axes of space that it lies along.
    """
    ring = np.asarray(ring, float)
    centre = ring.mean(axis=0)
    facing = cross(ring - centre, np.roll(ring, -1, axis=0) - centre).sum(axis=0) * (1 if top else -1)
    first = np.arange(len(ring))
    second = np.roll(first, -1)
    around = (first, second) if top else (second, first)
    faces = np.stack([*around, np.full(len(ring), len(ring))], axis=1)
    positions = np.vstack([ring, centre])
    normals = np.tile(facing / max(np.linalg.norm(facing), 1e-12), (len(positions), 1))
    plane = [[2, 1], [0, 2], [0, 1]][int(np.argmax(np.abs(facing)))]
    return _without_slivers(Mesh(positions, faces, normals, positions[:, plane]))


def loft(rings, *, closed=False, crease=CREASE) -> Mesh:
    """Surface through rings (r, c, 3), each a closed loop; with lids on both ends, or closed end to end."""
    rings = np.asarray(rings, float)
    side = patch(rings, wrap_columns=True, wrap_rows=closed, crease=crease)
    if closed:
        return side
    return merge([side, cap(rings[0], top=False), cap(rings[-1], top=True)])


def shell(points, thickness: float, crease=CREASE) -> Mesh:
    """Sheet of a thickness behind a grid (r, c, 3) whose front faces along d_columns x d_rows."""
    front = np.asarray(points, float)
    facing = cross(np.gradient(front, axis=1), np.gradient(front, axis=0))
    back = front - thickness * facing / np.linalg.norm(facing, axis=-1, keepdims=True)
    return merge(
        [
            patch(front, crease=crease),
            patch(back[:, ::-1], crease=crease),
            patch(np.stack([back[0], front[0]]), crease=crease),
            patch(np.stack([front[-1], back[-1]]), crease=crease),
            patch(np.stack([back[:, 0], front[:, 0]], axis=1), crease=crease),
            patch(np.stack([front[:, -1], back[:, -1]], axis=1), crease=crease),
        ]
    )


# ---------------------------------------------------------------- solids


def box(size, bevel=0.0, steps=1) -> Mesh:
    """Box of size (x, y, z) about 0; edges cut (steps 1) or rounded (steps 3) over `bevel`; grain along its length."""
    size = np.asarray(size, float)
    long = int(np.argmax(size))
    cross, other = (long + 1) % 3, (long + 2) % 3
    bevel = min(bevel, 0.49 * size.min())
    angle = np.linspace(0, np.pi / 2, steps + 1) if bevel > 0 else np.zeros(1)
    inset = bevel * (1 - np.sin(angle))
    height = -size[long] / 2 + bevel * (1 - np.cos(angle))
    inset, height = np.concatenate([inset, inset[::-1]]), np.concatenate([height, -height[::-1]])
    wide, tall = size[[cross, other]]
    outlines = [rounded_rectangle(wide, tall)] * 2
    if bevel > 0:
        outlines = [rounded_rectangle(wide - 2 * cut, tall - 2 * cut, max(bevel - cut, 1e-9), steps) for cut in inset]
    rings = np.empty((len(inset), len(outlines[0]), 3))
    rings[:, :, [cross, other]] = outlines
    rings[:, :, long] = height[:, None]
    return loft(rings)


def prism(outline, depth: float, bevel=0.0) -> Mesh:
    """Outline (k, 2) in x, y pushed out to z = +-depth/2; its edges cut by shrinking the ends towards the centre."""
    outline = np.asarray(outline, float)
    centre = outline.mean(axis=0)
    shrunk = centre + (outline - centre) * (1 - bevel / np.linalg.norm(outline - centre, axis=1).max())
    half = depth / 2
    levels = [(outline, -half), (outline, half)]
    if bevel > 0:
        levels = [(shrunk, -half), (outline, -half + bevel), (outline, half - bevel), (shrunk, half)]
    return loft([np.column_stack([line, np.full(len(line), z)]) for line, z in levels])


def lathe(profile, segments=24, *, closed=False, crease=CREASE) -> Mesh:
    """Profile (n, 2) of (radius, y), bottom to top along the outside, turned about y; `closed` makes a ring of it."""
    profile = np.asarray(profile, float)
    around = circle(segments)
    radius, y = profile[:, :1], profile[:, 1:]
    rings = np.stack(np.broadcast_arrays(radius * around[:, 0], y, -radius * around[:, 1]), axis=-1)
    return loft(rings, closed=closed, crease=crease)


def cylinder(radius: float, height: float, segments=24, bevel=0.0) -> Mesh:
    """Cylinder about y, from y = 0 to height, with cut edges."""
    if bevel <= 0:
        return lathe([(radius, 0), (radius, height)], segments)
    inner = radius - bevel
    return lathe([(inner, 0), (radius, bevel), (radius, height - bevel), (inner, height)], segments)


def tube(path, radius, *, segments=10, section=None) -> Mesh:
    """Circle (or `section` (k, 2)) of a radius () or (n,) swept along a path (n, 3) without twist."""
    path = np.asarray(path, float)
    section = circle(segments) if section is None else np.asarray(section, float)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.eye(3)[int(np.argmin(np.abs(tangent).max(axis=0)))]
    rings = np.empty((len(path), len(section), 3))
    scale = np.broadcast_to(radius, len(path))
    for i, forward in enumerate(tangent):
        side = side - forward * (side @ forward)
        side = side / np.linalg.norm(side)
        rings[i] = path[i] + scale[i] * (section @ np.stack([side, cross(forward, side)]))
    return loft(rings)


def superellipsoid(size, vertical, around, rows=12, segments=24) -> Mesh:
    """Rounded solid of size (x, y, z) about 0: exponents 1 an ellipsoid, towards 0 a box; a cushion is about 0.4."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)
    radius = np.abs(np.cos(latitude)) ** vertical
    radius[[0, -1]] = 0
    height = np.sign(latitude) * np.abs(np.sin(latitude)) ** vertical
    ring = superellipse(segments, around)
    x, z = radius[:, None] * ring[:, 0], -radius[:, None] * ring[:, 1]
    grid = np.stack(np.broadcast_arrays(x, height[:, None], z), axis=-1)
    return patch(grid * np.asarray(size, float) / 2, wrap_columns=True, crease=60)


def moulding(width: float, height: float, profile) -> Mesh:
    """Rectangle of (width, height) in x, y, mitred from a profile (k, 2) of (outward, z), counter-clockwise."""
    profile = np.asarray(profile, float)
    corners = np.array([(1, -1), (1, 1), (-1, 1), (-1, -1)], float)
    outward, z = profile[:, 0], profile[:, 1]
    rings = [np.column_stack([x * (width / 2 + outward), y * (height / 2 + outward), z])[::-1] for x, y in corners]
    return loft(rings, closed=True, crease=30.7)


# ---------------------------------------------------------------- placing


def merge(meshes) -> Mesh:
    """One mesh of several, in order."""
    meshes = list(meshes)
    starts = np.cumsum([0] + [len(mesh.positions) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.positions for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.texcoords for mesh in meshes]),
    )


def move(mesh: Mesh, x=0.0, y=0.0, z=0.0) -> Mesh:
    """The mesh shifted."""
    return mesh._replace(positions=mesh.positions + (x, y, z))


def turn(mesh: Mesh, axis: str, degrees: float) -> Mesh:
    """The mesh turned about an axis "x", "y" or "z" through 0, counter-clockwise seen from its positive end."""
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix[first, first] = matrix[second, second] = cosine
    matrix[first, second], matrix[second, first] = -sine, sine
    return mesh._replace(positions=mesh.positions @ matrix.T, normals=mesh.normals @ matrix.T)


def mirror(mesh: Mesh) -> Mesh:
    """The mesh mirrored at x = 0, still facing outward."""
    flip = np.array([-1.0, 1.0, 1.0])
    return mesh._replace(positions=mesh.positions * flip, normals=mesh.normals * flip, faces=mesh.faces[:, ::-1])


def both_sides(mesh: Mesh) -> Mesh:
    """The mesh and its mirror image at x = 0."""
    return merge([mesh, mirror(mesh)])
