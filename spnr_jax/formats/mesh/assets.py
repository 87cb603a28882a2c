"""What every source of objects hands on: parts of triangles with principled materials.

Conventions, fixed here and nowhere else:
  axes        right-handed, y up (as in glTF), any unit; `normalise` brings an object into the unit sphere
  colours     linear RGB in [0, 1]
  textures    rows of texels; texture coordinate (u, v) = (0, 0) is the outer corner of texel [0, 0], v runs down the
              rows (as in glTF; mitsuba's `bitmap` reads the same way)
  faces       counted through all parts of an object in order: global face = faces of the parts before + local face
The renderer (what the network is shown) and the point sampler (what it is told) both read these records, so the two
cannot disagree about a material.  What only a picture of points needs (cut-outs, normal maps, textures with
coordinates of their own) is read where transparent parts are allowed, and never reaches the renderer.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from spnr_jax.errors import UserError

Wrap = Literal["repeat", "mirror", "clamp"]
Values = np.ndarray | np.floating  # NumPy makes numbers of arrays without axes
ShownParts = Literal["opaque", "skip"]
# What becomes of parts that light passes through: refuse the object, as references need, draw them as if they were
# opaque, or leave them out; where they are not refused, a texture that is missing is no reason to refuse either.
TransparentParts = Literal["refuse", ShownParts]
CHANNELS = {"base_color": 1, "roughness": 0, "metallic": 0}  # of a material, and axes of one value
TEXTURES = {"opacity": 0, "normal_map": 1}  # of a material that may be absent, and axes of one texel


class RejectedAsset(UserError):
    """An object that cannot be used; the message is the one-line reason that goes into rejected.jsonl."""


class MissingFile(RejectedAsset):
    """A file that a mesh file names is not there, or lies where it must not be looked for."""


def extra(package: str) -> Any:
    """A package of the extra `meshes`; RejectedAsset where it is not installed."""
    try:
        return importlib.import_module(package)
    except ImportError:
        raise RejectedAsset(f"needs the package {package} to be read: pip install 'spnr-jax[meshes]'") from None


@dataclass(frozen=True, kw_only=True)
class Material:
    """A principled (metallic-roughness) material; each channel is one value or a texture of its own size.

    base_color: (3,) or (height, width, 3); roughness, metallic: () or (height, width). All float32 in [0, 1], linear.
    opacity (height, width) or None: there is surface where it is at least `cutoff`.
    normal_map (height, width, 3) or None: normals along the directions in which u grows, in which v falls, and
    outwards, of any length.
    `coordinates` names the channels that lie by other texture coordinates than the first: their number, their wrap.
    """

    base_color: np.ndarray
    roughness: Values
    metallic: Values
    wrap: Wrap = "repeat"
    opacity: np.ndarray | None = None
    cutoff: float | int = 0.5
    normal_map: np.ndarray | None = None
    coordinates: Mapping[str, tuple[int, Wrap]] = field(default_factory=dict)

    @property
    def textured(self) -> bool:
        """Whether anything of it needs texture coordinates."""
        channels = any(np.ndim(getattr(self, name)) > axes for name, axes in CHANNELS.items())
        return channels or self.opacity is not None or self.normal_map is not None


@dataclass(frozen=True, kw_only=True)
class Part:
    """Triangles that share one material.

    positions (v, 3) float64; faces (f, 3) int64, counter-clockwise seen from outside where the source knows;
    normals (v, 3) unit, or None for flat shading; texcoords (v, 2), needed only if the material has a texture, or
    (v, 2 n) for n pairs of coordinates, of which `Material.coordinates` counts from 0;
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
    """One object: its parts, what kind it is, and what its source holds that is not modelled (named, never silent).

    `notes` are sentences about what was made of transparent parts and of files that are missing.
    """

    parts: tuple[Part, ...]
    category: str = "object"
    ignored: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    source: dict = field(default_factory=dict)


def make_material(
    base_color: Values | float | int = 0.5,
    roughness: Values | float | int = 0.5,
    metallic: Values | float | int = 0.0,
    wrap: Wrap = "repeat",
) -> Material:
    """A material of float32 channels in [0, 1]; grey of roughness 0.5 where nothing is given."""
    color, *values = (np.clip(np.asarray(x, np.float32), 0, 1) for x in (base_color, roughness, metallic))
    color = np.full(3, color) if color.ndim == 0 else color
    return Material(base_color=color, roughness=values[0], metallic=values[1], wrap=wrap)
