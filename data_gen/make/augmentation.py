"""Variants of an object in colour and shape.

Colour: one rotation in linear RGB space about the grey axis, the line from black through mid-grey to white, applied to
all base colours. It is linear, keeps the distances between colours, every grey as it is and the mean of the three
channels, so of all rotations about mid-grey it leaves the gamut [0, 1]^3 least. An angle is drawn uniformly from the
whole turn but for LEAST_DEGREES about no turn at all; one that takes any colour of the object out of the gamut is drawn
again, MAX_DRAWS times at most. Then a third of a turn, one way or the other, is taken: it permutes red, green and blue,
so nothing can leave the gamut; object.json names such an object (`fallback`). A flat colour, vertex colours (times the
flat colour that they multiply) and every texel are rotated. Interpolation and texture lookup are averages, with which a
linear map commutes: the variant's colour at a point is the rotation of the original's. Roughness, metallic and shape
stay.

Shape: turned about the up axis, mirrored or not, stretched, its roughness bent. The light is fixed to the world, so a
turned object is lit from another side: this cannot be done to finished pictures. The angle is uniform, a mirror image
is as likely as not, each axis of the object grows by a factor of at most MOST_STRETCH or shrinks by as much, and
roughness becomes its power by an exponent of at most MOST_BEND or its inverse (0 stays 0 and 1 stays 1); factors and
exponents are uniform in their logarithm.
"""

from dataclasses import dataclass, replace

import numpy as np

from spnr_jax.formats.assets import Asset, Part
from spnr_jax.kernels.triangles import unit

MOST_STRETCH, MOST_BEND = 1.25, 2.0


@dataclass(frozen=True, kw_only=True)
class Reshaping:
    """Stretch of the axes (3,), a negative first one for a mirror image, then a turn; and the exponent of roughness."""

    stretch: np.ndarray
    degrees: float
    roughness_exponent: float

    def matrix(self) -> np.ndarray:
        """The linear map (3, 3) of positions."""
        angle = np.radians(self.degrees)
        cos, sin = np.cos(angle), np.sin(angle)
        return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]) @ np.diag(self.stretch)

    def describe(self) -> dict:
        """The reshaping as it stands in object.json."""
        return {**vars(self), "stretch": self.stretch.tolist()}


def draw_reshaping(seed: int) -> Reshaping:
    """A random reshaping, a function of the seed."""
    rng = np.random.default_rng(seed)
    stretch = MOST_STRETCH ** rng.uniform(-1, 1, 3)
    stretch[0] *= rng.choice([-1, 1])
    return Reshaping(
        stretch=stretch, degrees=rng.uniform(0, 360), roughness_exponent=float(MOST_BEND ** rng.uniform(-1, 1))
    )


def reshape(asset: Asset, reshaping: Reshaping) -> Asset:
    """The asset in its new shape; a mirror image's faces are turned round, so that they still face outwards."""
    return replace(asset, parts=tuple(reshape_part(part, reshaping) for part in asset.parts))


def reshape_part(part: Part, reshaping: Reshaping) -> Part:
    """A part with its positions, normals, faces and roughness changed."""
    matrix = reshaping.matrix()
    normals = part.normals
    if normals is not None:
        normals = unit(normals @ np.linalg.inv(matrix))  # rows: the inverse transpose of the map
    roughness = np.power(part.material.roughness, np.float32(reshaping.roughness_exponent))
    return replace(
        part,
        positions=part.positions @ matrix.T,
        normals=normals,
        faces=part.faces[:, ::-1] if np.linalg.det(matrix) < 0 else part.faces,
        material=replace(part.material, roughness=np.asarray(roughness, np.float32)),
    )


MAX_DRAWS = 64
TURNS = 24  # of the coarse grid that finds extreme colours
LEAST_DEGREES = 30  # a smaller turn is hardly a variant, and the only kind that saturated colours have room for
ROUNDING = 1e-6  # of a rotated float32 colour; what it exceeds the gamut by is clipped


@dataclass(frozen=True, kw_only=True)
class ColorRotation:
    """A rotation (3, 3) about the grey axis, its angle, and how it was found."""

    matrix: np.ndarray
    degrees: float
    draws: int
    fallback: bool

    def describe(self) -> dict:
        """The rotation as it stands in object.json."""
        return {**vars(self), "matrix": self.matrix.tolist()}


def rotate_colors(asset: Asset, seed: int) -> tuple[Asset, ColorRotation]:
    """The asset with its base colours rotated, and the rotation, a function of the colours and the seed."""
    rotation = draw_rotation(base_colors(asset), seed)
    return replace(asset, parts=tuple(rotate_part(part, rotation.matrix) for part in asset.parts)), rotation


def base_colors(asset: Asset) -> np.ndarray:
    """Every base colour (n, 3) of the asset: flat ones, at vertices, and all texels."""
    return np.concatenate([part_colors(part).reshape(-1, 3) for part in asset.parts])


def part_colors(part: Part) -> np.ndarray:
    """The base colours (3,), (v, 3) or (height, width, 3) of a part, vertex colours times the material's."""
    if part.colors is None:
        return part.material.base_color
    assert part.material.base_color.ndim == 1, "a textured part has no vertex colours: its texture is tinted instead"
    return part.colors * part.material.base_color


def draw_rotation(colours: np.ndarray, seed: int) -> ColorRotation:
    """A random rotation about the grey axis that keeps the colours (n, 3) in the gamut."""
    rng = np.random.default_rng(seed)
    extreme = extreme_colors(colours)  # nearly every draw that fails, fails for one of these few
    for draw in range(1, MAX_DRAWS + 1):
        degrees = rng.uniform(LEAST_DEGREES, 360 - LEAST_DEGREES)
        matrix = grey_rotation(degrees)
        if in_gamut(extreme, matrix) and in_gamut(colours, matrix):
            return ColorRotation(matrix=matrix, degrees=degrees, draws=draw, fallback=False)
    degrees = float(rng.choice([120, 240]))
    return ColorRotation(matrix=grey_rotation(degrees), degrees=degrees, draws=MAX_DRAWS, fallback=True)


def grey_rotation(degrees: float) -> np.ndarray:
    """The rotation (3, 3) by an angle about the grey axis; 120 degrees take red to green (Rodrigues)."""
    angle = np.radians(degrees)
    along = np.full((3, 3), 1 / 3)
    across = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)
    return np.cos(angle) * (np.eye(3) - along) + np.sin(angle) * across + along


def extreme_colors(colours: np.ndarray) -> np.ndarray:
    """The colours (m, 3) that some rotation of a coarse grid takes furthest up or down in a channel."""
    rows = np.stack([grey_rotation(degrees)[0] for degrees in np.linspace(0, 360, TURNS, endpoint=False)])
    first = [
        np.array([values.argmin(), values.argmax()]) for values in (colours @ row.astype(colours.dtype) for row in rows)
    ]
    return colours[np.unique(np.concatenate(first))]


def in_gamut(colours: np.ndarray, matrix: np.ndarray) -> bool:
    """Whether the rotated colours all lie in [0, 1]^3, but for rounding."""
    rotated = colours @ matrix.T.astype(colours.dtype)
    return bool(rotated.min() >= -ROUNDING and rotated.max() <= 1 + ROUNDING)


def rotate_part(part: Part, matrix: np.ndarray) -> Part:
    """The part with its base colours rotated; vertex colours take up the colour that they multiplied."""
    rotated = np.clip(part_colors(part) @ matrix.T, 0, 1)
    if part.colors is None:
        return replace(part, material=replace(part.material, base_color=rotated.astype(np.float32)))
    return replace(part, colors=rotated, material=replace(part.material, base_color=np.ones(3, np.float32)))
