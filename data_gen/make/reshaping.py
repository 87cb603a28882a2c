"""Shape variants of an object: turned about the up axis, mirrored or not, stretched, its roughness bent.

The light is fixed to the world, so a turned object is lit from another side: this cannot be done to finished pictures.
The angle is uniform, a mirror image is as likely as not, each axis of the object grows by a factor of at most
MOST_STRETCH or shrinks by as much, and roughness becomes its power by an exponent of at most MOST_BEND or its inverse
(0 stays 0 and 1 stays 1); factors and exponents are uniform in their logarithm.
"""

from dataclasses import dataclass, replace

import numpy as np

from spnr_jax.formats.mesh.assets import Asset, Part
from spnr_jax.formats.mesh.surface_points import unit

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
    return replace(asset, parts=tuple(reshaped_part(part, reshaping) for part in asset.parts))


def reshaped_part(part: Part, reshaping: Reshaping) -> Part:
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
