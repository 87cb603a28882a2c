"""What every source of objects hands on: parts of triangles with principled materials.

Conventions, fixed here and nowhere else:
  axes        right-handed, y up (as in glTF), any unit; `normalise` brings an object into the unit sphere
  colours     linear RGB in [0, 1]
  textures    rows of texels; texture coordinate (u, v) = (0, 0) is the outer corner of texel [0, 0], v runs down the
              rows (as in glTF; mitsuba's `bitmap` reads the same way)
  faces       counted through all parts of an object in order: global face = faces of the parts before + local face
The renderer (what the network is shown) and the point sampler (what it is told) both read these records, so the two
cannot disagree about a material.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from spnr_jax.errors import UserError

Wrap = Literal["repeat", "mirror", "clamp"]
Values = np.ndarray | np.floating  # NumPy makes numbers of arrays without axes


class RejectedAsset(UserError):
    """An object that cannot be used; the message is the one-line reason that goes into rejected.jsonl."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """A principled (metallic-roughness) material; each channel is one value or a texture of its own size.

    base_color: (3,) or (height, width, 3); roughness, metallic: () or (height, width). All float32 in [0, 1], linear.
    """

    base_color: np.ndarray
    roughness: Values
    metallic: Values
    wrap: Wrap = "repeat"


@dataclass(frozen=True, kw_only=True)
class Part:
    """Triangles that share one material.

    positions (v, 3) float64; faces (f, 3) int64, counter-clockwise seen from outside where the source knows;
    normals (v, 3) unit, or None for flat shading; texcoords (v, 2), needed only if the material has a texture;
    colors (v, 3) linear, multiplies the material's base colour, or None.
    """

    positions: np.ndarray
    faces: np.ndarray
    material: Material
    normals: np.ndarray | None = None
    texcoords: np.ndarray | None = None
    colors: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class Asset:
    """One object: its parts, what kind it is, and what its source holds that is not modelled (named, never silent)."""

    parts: tuple[Part, ...]
    category: str = "object"
    ignored: tuple[str, ...] = ()
    source: dict = field(default_factory=dict)
