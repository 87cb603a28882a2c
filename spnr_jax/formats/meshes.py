"""Mesh files as assets: read (gltf.py, obj.py, polygons.py), checked, cleaned and merged by material.

check     indices in range, finite coordinates, an extent above zero
clean     remove faces without area, vertices without faces and unused columns; unit normals; colours in [0, 1]
merge     parts with equal materials become one part, because mitsuba compiles per part; smooth and flat parts stay
          separate, so that neither gets the other's normals
tint      for references, where mitsuba takes a texture or vertex colours but not both: the mean colour of the vertices
"""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from spnr_jax.errors import UserError, refusing
from spnr_jax.formats.assets import CHANNELS, Asset, Loading, Material, Part, TransparentParts, make_material
from spnr_jax.formats.columns import invisible
from spnr_jax.formats.gltf import load_gltf
from spnr_jax.formats.obj import load_obj
from spnr_jax.formats.polygons import PLAIN
from spnr_jax.formats.surface_points import bounding_box, face_areas
from spnr_jax.kernels.triangles import face_crosses, unit, vertex_normals

# Faces below this share of their longest edge squared (for references, of the box's diagonal) are rounding, no surface.
DEGENERATE_AREA = 1e-14
ACROSS = 0.5  # median cosine between normals and faces, below which the normals are ignored
MAX_TEXCOORD = 1e6  # beyond it the renderer's float32 cannot resolve neighbouring texels
WIDTHS = {"positions": 3, "normals": 3, "texcoords": 2, "colors": 3}  # arrays of a part, one row per vertex
READERS = {".glb": load_gltf, ".gltf": load_gltf, ".obj": load_obj} | PLAIN
SUFFIXES = tuple(READERS)


def load_mesh(
    path: Path, root: Path | None = None, transparent_parts: TransparentParts = "refuse", kind: str | None = None
) -> Asset:
    """The object in a mesh file, parts merged by material; `source` names the file and its checksum.

    `root`: the object's folder, where an .obj file's companions may be, above the file's folder (default: that folder).
    `kind`: the format as a suffix, if not the file's own.
    "refuse", for references: transparent parts and missing images or libraries are errors.  "opaque" and "skip", for
    pictures: these are replaced and mentioned in `notes`; invisible and non-finite faces are left out; cut-outs and
    normal maps, which the renderer of references lacks, are read.
    UserError if the file is unreadable or truncated, has no faces or extent, or lacks buffers.
    """
    path = Path(path)
    kind = kind or path.suffix.lower()
    loading = Loading(path.parent, root if kind == ".obj" else None, transparent_parts)
    with (
        refusing("cannot be read, the file is broken or truncated"),
        np.errstate(all="ignore"),  # `assemble` checks for what is not finite
    ):
        if kind not in READERS:
            raise UserError(f"has suffix {kind!r}; expected one of {' '.join(SUFFIXES)}")
        parts = READERS[kind](path, loading)
        if parts and not any(len(part.positions) for part in parts):
            raise UserError("has no faces, and no vertices")
        for part in parts:
            _check_columns(part)
        if loading.strict or not parts or any(len(part.faces) for part in parts):
            parts = assemble(parts, loading)
    source = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    ignored, notes = tuple(sorted(loading.ignored)), loading.notes()
    return Asset(parts=tuple(parts), ignored=ignored, notes=notes, source=source)


def assemble(parts: list[Part], loading: Loading) -> list[Part]:
    """The parts checked, cleaned, merged and, for references, tinted; changes are listed in `ignored`."""
    if not parts:
        raise UserError(f"has nothing to draw: {'; '.join(notes)}" if (notes := loading.notes()) else "has no faces")
    parts = parts if loading.strict else _without_false_normals(_visible(parts, loading), loading)
    low, high = bounding_box(Asset(parts=tuple(parts)))
    degenerate = 0
    groups: dict[tuple, list[Part]] = {}
    for whole in parts:
        edges = np.diff(whole.positions[whole.faces[:, [0, 1, 2, 0]]], axis=1)
        largest = np.sum((high - low) ** 2) if loading.strict else np.sum(edges**2, axis=-1).max(axis=-1)
        solid = face_areas(whole) > DEGENERATE_AREA * largest
        degenerate += int((~solid).sum())
        if solid.any():
            part = _clean_part(replace(whole, faces=whole.faces[solid]), loading)
            groups.setdefault((_identity(part.material), part.normals is None), []).append(part)
    if not groups:
        raise UserError("has no face with an area")
    loading.ignored |= {f"{degenerate} degenerate faces"} if degenerate else set()
    return list(map(_merge, groups.values()))


def _check_columns(part: Part) -> None:
    """UserError unless the arrays have one row per vertex and the faces index these."""
    count = len(part.positions)
    for name, width in WIDTHS.items():
        values = getattr(part, name)
        if values is not None and values.shape != (count, width):
            raise UserError(f"has {name} of shape {values.shape} where ({count}, {width}) is needed: broken file")
    first, last = part.faces.min(initial=0), part.faces.max(initial=-1)
    if first < 0 or last >= count:
        raise UserError(f"has faces that name vertices {first} to {last} of {count}: broken file")


def _visible(parts: list[Part], loading: Loading) -> list[Part]:
    """The parts without faces that have a non-finite vertex or only invisible ones; notes give their number."""
    lost = {"for a vertex that is NaN or infinity": 0, "for their alpha, near 0": 0}
    for number, part in enumerate(parts):
        hidden = invisible({"x": part.positions[:, 0]} | ({} if part.alpha is None else {"alpha": part.alpha}))
        broken = ~np.isfinite(part.positions[part.faces]).all(axis=(1, 2))
        masks = broken, hidden[part.faces].all(axis=1) & ~broken & ~hidden.all()
        lost = {reason: count + int(mask.sum()) for (reason, count), mask in zip(lost.items(), masks, strict=True)}
        parts[number] = replace(part, faces=part.faces[~np.any(masks, axis=0)])
    for reason, count in lost.items():
        if count:
            loading.say(f"{count:,} {'face' if count == 1 else 'faces'} left out {reason}")
    return parts


def _without_false_normals(parts: list[Part], loading: Loading) -> list[Part]:
    """The parts, without their normals if most of these lie across the faces (written in other axes)."""
    cosines = [np.zeros(0)]
    for part in parts:
        if part.normals is not None:
            mean, flat = part.normals[part.faces].sum(axis=1), face_crosses(part.positions, part.faces)
            cosines.append(np.abs(np.sum(unit(mean) * unit(flat), axis=-1)))
    known = np.concatenate(cosines)
    if not (len(known) and np.median(known) < ACROSS):
        return parts
    loading.say("normals of the file left out: they lie across its faces")
    return [replace(part, normals=None) for part in parts]


def _clean_part(part: Part, loading: Loading) -> Part:
    """The part with the vertices that its faces use, in their order, and the columns that its material needs."""
    used, faces = np.unique(part.faces, return_inverse=True)
    columns: dict[str, Any] = {name: values[used] for name in WIDTHS if (values := getattr(part, name)) is not None}
    part = replace(part, **columns, alpha=None, faces=faces.reshape(-1, 3).astype(np.int64))
    part = replace(part, normals=_unit_normals(part, loading.ignored), colors=_check_colors(part, loading.ignored))
    look, texcoords = part.material, part.texcoords
    if not any(np.ndim(getattr(look, name)) > axes for name, axes in CHANNELS.items()):
        return replace(part, texcoords=None)
    if texcoords is None:
        loading.ignored.add("texture on faces without texture coordinates (its mean is used)")
        color = look.base_color.reshape(-1, 3).mean(axis=0)
        look = make_material(color, look.roughness.mean(), look.metallic.mean(), look.wrap)
    elif not (np.abs(texcoords) < MAX_TEXCOORD).all():
        raise UserError(f"has texture coordinates that are not finite, or beyond {MAX_TEXCOORD:g}: broken file")
    if loading.strict and part.colors is not None and look.base_color.ndim > 1:
        tint = part.colors[part.faces].mean(axis=(0, 1))
        if np.abs(part.colors - tint).max() > 1 / 255:
            loading.ignored.add("vertex colours that vary over a texture (their mean is used)")
        look, part = replace(look, base_color=look.base_color * tint.astype(np.float32)), replace(part, colors=None)
    return replace(part, material=look)


def _unit_normals(part: Part, ignored: set[str]) -> np.ndarray | None:
    """Unit normals (v, 3) of a part; a zero or non-finite one is replaced by the mean of its faces' normals."""
    if part.normals is None:
        return None
    length = np.linalg.norm(part.normals, axis=-1, keepdims=True)
    good = np.isfinite(length) & (length > 0)
    if good.all():
        return part.normals / length
    if not good.any():
        ignored.add("normals without a direction (flat shading is used)")
        return None
    ignored.add("some normals without a direction (the faces' are used)")
    return np.where(good, unit(part.normals), vertex_normals(part.positions, part.faces))


def _check_colors(part: Part, ignored: set[str]) -> np.ndarray | None:
    """The part's vertex colours in [0, 1]; None if all are white."""
    if part.colors is None or (part.colors == 1).all():
        return None
    if not np.isfinite(part.colors).all():
        raise UserError("has vertex colours that are not finite (NaN or infinity)")
    if part.colors.max() > 2:
        raise UserError(f"has linear vertex colours up to {part.colors.max():g}; expected 0 to 1")
    if part.colors.min() < 0 or part.colors.max() > 1:
        ignored.add("vertex colours outside [0, 1] (clipped)")
    return np.clip(part.colors, 0, 1)


def _identity(material: Material) -> tuple:
    """A hashable key of a material: its values, and digests of its textures."""
    values = vars(material).values()
    return tuple((x.shape, hashlib.sha256(x.tobytes()).digest()) if isinstance(x, np.ndarray) else x for x in values)


def _merge(parts: list[Part]) -> Part:
    """One part of several with the same material, all or none with normals; missing colours become white."""
    tinted = any(part.colors is not None for part in parts)
    parts = [replace(x, colors=np.ones_like(x.positions)) if tinted and x.colors is None else x for x in parts]
    names = [name for name in WIDTHS if getattr(parts[0], name) is not None]
    columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    first = np.cumsum([0, *(len(part.positions) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, first, strict=False)]
    return replace(parts[0], faces=np.concatenate(faces), **columns)
