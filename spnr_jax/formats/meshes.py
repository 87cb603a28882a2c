"""Mesh files as assets: read, checked, cleaned and merged by material.

glTF and GLB carry principled materials (gltf.py), OBJ gets them from its MTL (obj.py); PLY, STL and OFF (polygons.py)
have vertex or face colours at most, read as those of points are (columns.py), grey 0.5 otherwise.

checked   indices inside, coordinates finite, an extent above zero
cleaned   faces without area and vertices without faces removed; normals unit; colours in [0, 1]; unused columns gone
merged    parts with equal materials (by value) are one part: a renderer compiles per part. Smooth and flat parts stay
          apart, so that neither takes on the other's normals.
tinted    a renderer of references takes either a texture or colours at vertices: of colours on a texture their mean
Every reason not to use a file is a RejectedAsset with one line.
"""

import contextlib
import hashlib
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from spnr_jax.errors import UserError, refusing
from spnr_jax.formats.assets import (
    Asset,
    Material,
    Part,
    RejectedAsset,
    TransparentParts,
    make_material,
)
from spnr_jax.formats.columns import full_scale
from spnr_jax.formats.gltf import load_gltf
from spnr_jax.formats.obj import load_obj
from spnr_jax.formats.polygons import PLAIN
from spnr_jax.formats.surface_points import bounding_box, face_areas, face_crosses, unit, vertex_normals

# Faces below this share of the squared box diagonal are float32 rounding, not surface.
DEGENERATE_AREA = 1e-14
ACROSS = 0.5  # median cosine between normals and faces, below which the normals are not those of the faces
MAX_TEXCOORD = 1e6  # beyond it float32, in which the renderer computes, cannot tell neighbouring texels apart
WIDTHS = {"positions": 3, "normals": 3, "texcoords": 2, "colors": 3}  # columns of a part, one row per vertex
SUFFIXES = (".glb", ".gltf", ".obj", *PLAIN)


def assemble(asset: Asset, strict: bool) -> Asset:
    """The asset with its parts checked, cleaned, merged and, for references, tinted; changes are named in `ignored`."""
    for part in asset.parts:
        _check_columns(part)
    asset = asset if strict else _finite(asset)
    low, high = bounding_box(asset)
    asset = asset if strict else _without_false_normals(asset)
    smallest = DEGENERATE_AREA * np.sum((high - low) ** 2)
    notes: set[str] = set(asset.ignored)
    degenerate = 0
    groups: dict[tuple, list[Part]] = {}
    for whole in asset.parts:
        solid = face_areas(whole) > smallest
        degenerate += int((~solid).sum())
        if not solid.any():
            continue
        part = _clean_part(replace(whole, faces=whole.faces[solid]), notes, strict)
        groups.setdefault((_identity(part.material), part.normals is None), []).append(part)
    if not groups:
        raise RejectedAsset("has no face with an area")
    if degenerate:
        notes.add(f"{degenerate} degenerate faces")
    return replace(asset, parts=tuple(map(_merge, groups.values())), ignored=tuple(sorted(notes)))


def _finite(asset: Asset) -> Asset:
    """The asset without faces that have a vertex which is not finite, and a note about how many these are."""
    sound = [np.isfinite(part.positions[part.faces]).all(axis=(1, 2)) for part in asset.parts]
    lost = sum(int((~faces).sum()) for faces in sound)
    if not lost:
        return asset
    parts = tuple(replace(part, faces=part.faces[faces]) for part, faces in zip(asset.parts, sound, strict=True))
    note = f"{lost:,} {'face' if lost == 1 else 'faces'} left out for a vertex that is NaN or infinity"
    return replace(asset, parts=parts, notes=(*asset.notes, note))


def _without_false_normals(asset: Asset) -> Asset:
    """The asset without normals where most lie across their faces, as those of other axes do."""
    shaded = [part for part in asset.parts if part.normals is not None and len(part.faces)]
    means = [unit(part.normals[part.faces].sum(axis=1)) for part in shaded if part.normals is not None]
    flat = [unit(face_crosses(part.positions, part.faces)) for part in shaded]
    cosines = [np.abs(np.sum(mean * normals, axis=-1)) for mean, normals in zip(means, flat, strict=True)]
    if not cosines or not np.median(np.concatenate(cosines)) < ACROSS:
        return asset
    note = "normals of the file left out: they lie across its faces"
    return replace(asset, parts=tuple(replace(part, normals=None) for part in asset.parts), notes=(*asset.notes, note))


def _check_columns(part: Part) -> None:
    """Refuse a part whose columns do not have one row per vertex, or whose faces name vertices that are not there."""
    count = len(part.positions)
    for name, width in WIDTHS.items():
        values = getattr(part, name)
        if values is not None and values.shape != (count, width):
            raise RejectedAsset(f"has {name} of shape {values.shape} where ({count}, {width}) is needed: broken file")
    if part.faces.size and not 0 <= part.faces.min() <= part.faces.max() < count:
        raise RejectedAsset(
            f"has faces that name vertices {part.faces.min()} to {part.faces.max()} of {count}: broken file"
        )


def _clean_part(part: Part, notes: set[str], strict: bool) -> Part:
    """The part with just the vertices that its faces use, in their order, and the columns that its material needs."""
    used, faces = np.unique(part.faces, return_inverse=True)
    kept: dict[str, Any] = {name: getattr(part, name) for name in WIDTHS}
    kept = {name: None if values is None else values[used] for name, values in kept.items()}
    part = _settle_texture(replace(part, **kept, faces=faces.reshape(-1, 3).astype(np.int64)), notes)
    part = replace(part, normals=_unit_normals(part, notes), colors=_check_colors(part, notes))
    if part.colors is None or part.material.base_color.ndim == 1 or not strict:
        return part
    tint = part.colors[part.faces].mean(axis=(0, 1))
    if np.abs(part.colors - tint).max() > 1 / 255:
        notes.add("vertex colours that vary over a texture (their mean is used)")
    look = replace(part.material, base_color=part.material.base_color * tint.astype(np.float32))
    return replace(part, material=look, colors=None)


def _settle_texture(part: Part, notes: set[str]) -> Part:
    """The part with texture coordinates exactly where its material needs them; a texture without any: its mean."""
    if not part.material.textured:
        return replace(part, texcoords=None)
    if part.texcoords is None:
        notes.add("texture on faces without texture coordinates (its mean is used)")
        look = part.material
        color = look.base_color.reshape(-1, 3).mean(axis=0)
        return replace(part, material=make_material(color, look.roughness.mean(), look.metallic.mean(), look.wrap))
    if not (np.abs(part.texcoords) < MAX_TEXCOORD).all():
        raise RejectedAsset(f"has texture coordinates that are not finite, or beyond {MAX_TEXCOORD:g}: broken file")
    return part


def _unit_normals(part: Part, notes: set[str]) -> np.ndarray | None:
    """The part's normals (v, 3) at length 1; one that is zero or not finite becomes the mean of its faces' normals."""
    if part.normals is None:
        return None
    length = np.linalg.norm(part.normals, axis=-1)
    good = np.isfinite(length) & (length > 0)
    if not good.any():
        notes.add("normals without a direction (flat shading is used)")
        return None
    if good.all():
        return part.normals / length[:, None]
    notes.add("some normals without a direction (the faces' are used)")
    own = unit(np.where(good[:, None], part.normals, 0))
    return np.where(good[:, None], own, vertex_normals(part.positions, part.faces))


def _check_colors(part: Part, notes: set[str]) -> np.ndarray | None:
    """The part's vertex colours in [0, 1]; None where they are all white."""
    if part.colors is None or (part.colors == 1).all():
        return None
    if not np.isfinite(part.colors).all():
        raise RejectedAsset("has vertex colours that are not finite (NaN or infinity)")
    highest = float(part.colors.max())
    white = full_scale(part.colors.dtype, highest, linear=highest < 2)
    if white > 1:
        notes.add(f"vertex colours up to {highest:g} (taken as linear in 0..{white:g})")
    elif part.colors.min() < 0 or highest > 1:
        notes.add("vertex colours outside [0, 1] (clipped)")
    return np.clip(part.colors / white, 0, 1)


def _identity(material: Material) -> tuple:
    """Everything that a material says, with digests of its textures."""
    values = vars(material).values()
    return tuple(
        (np.shape(x), hashlib.sha256(x.tobytes()).digest()) if isinstance(x, np.ndarray) else x for x in values
    )


def _merge(parts: list[Part]) -> Part:
    """One part of several that agree in material and in having normals; missing colours are white."""
    first = np.cumsum([0, *(len(part.positions) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, first, strict=False)]
    columns: dict[str, list] = {name: [getattr(part, name) for part in parts] for name in WIDTHS}
    if any(colors is not None for colors in columns["colors"]):
        columns["colors"] = [np.ones_like(p.positions) if p.colors is None else p.colors for p in parts]
    whole: dict[str, Any] = {
        name: None if values[0] is None else np.concatenate(values) for name, values in columns.items()
    }
    return replace(parts[0], faces=np.concatenate(faces), **whole)


def load_mesh(
    path: Path, root: Path | None = None, transparent_parts: TransparentParts = "refuse", kind: str | None = None
) -> Asset:
    """The object in a mesh file, parts merged by material; `source` names the file and its checksum.

    `root` is the object's folder, which may hold an .obj file's companions above it (default: the file's folder).
    RejectedAsset, with one line, for a file that cannot be used: unreadable or truncated, without faces or extent,
    with buffers missing or outside its folder.  "refuse", for references, also refuses what is transparent and images
    and libraries that are missing; "opaque" and "skip", for pictures, say in `notes` what was made of them, leave out
    faces whose vertices are not finite, and read what the renderer of references does not know: cut-outs, normal maps.
    `kind` is a suffix to go by instead of the file's.
    """
    path = Path(path)
    kind = kind or path.suffix.lower()
    with _refusing():
        if kind in (".glb", ".gltf"):
            asset = load_gltf(path, transparent_parts)
        elif kind == ".obj":
            asset = load_obj(path, root, transparent_parts)
        elif kind in PLAIN:
            asset = PLAIN[kind](path.read_bytes())
        else:
            raise RejectedAsset(f"has suffix {kind!r}; expected one of {' '.join(SUFFIXES)}")
        strict = transparent_parts == "refuse"
        asset = asset if asset.points and not strict else assemble(asset, strict)
    return replace(asset, source={"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()})


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """RejectedAsset, meanwhile, where libraries stumble over a file."""
    try:
        with (
            refusing("cannot be read, the file is broken or truncated"),
            warnings.catch_warnings(),
            np.errstate(all="ignore"),  # assemble looks for what is not finite
        ):
            # numpy only warns where the text of a file stops being numbers
            warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
            yield
    except RejectedAsset:
        raise
    except UserError as error:
        raise RejectedAsset(str(error)) from error
