"""From what a mesh file holds to what the rest of data_gen may rely on: checked, cleaned, merged by material.

checked   indices inside, coordinates finite, an extent above zero
cleaned   faces without area and vertices without faces removed; normals unit; colours in [0, 1]; unused columns gone
merged    parts with equal materials (by value) are one part: a renderer compiles per part. Smooth and flat parts stay
          apart, so that neither takes on the other's normals.
"""

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np

from spnr_jax.formats.mesh.assets import CHANNELS, TEXTURES, Asset, Material, Part, RejectedAsset
from spnr_jax.formats.mesh.surface_points import bounding_box, face_areas, unit, vertex_normals
from spnr_jax.formats.mesh.tints import split_by_tint

# Faces below this share of the squared box diagonal are float32 rounding, not surface.
DEGENERATE_AREA = 1e-14
MAX_TEXCOORD = 1e6  # beyond it float32, in which the renderer computes, cannot tell neighbouring texels apart
WIDTHS = {"positions": 3, "normals": 3, "texcoords": 2, "colors": 3}  # columns of a part, one row per vertex


def assemble(asset: Asset) -> Asset:
    """The asset with its parts checked, cleaned and merged; what was changed is added to `ignored`."""
    for part in asset.parts:
        _check_columns(part)
        _check_material(part.material)
    low, high = bounding_box(asset)
    smallest = DEGENERATE_AREA * np.sum((high - low) ** 2)
    notes: set[str] = set(asset.ignored)
    degenerate = 0
    groups: dict[tuple, list[Part]] = {}
    identities: dict[int, str] = {}  # by id: `groups` and `asset` keep every material alive
    for whole in asset.parts:
        solid = face_areas(whole) > smallest
        degenerate += int((~solid).sum())
        for part in _cleaned(replace(whole, faces=whole.faces[solid]), notes) if solid.any() else ():
            key = identities.setdefault(id(part.material), _identity(part.material)), part.normals is None
            groups.setdefault(key, []).append(part)
    if not groups:
        raise RejectedAsset("has no face with an area")
    if degenerate:
        notes.add(f"{degenerate} degenerate faces")
    return replace(asset, parts=tuple(map(_merge, groups.values())), ignored=tuple(sorted(notes)))


def _check_columns(part: Part) -> None:
    """Refuse a part whose columns do not have one row per vertex, or whose faces name vertices that are not there."""
    count = len(part.positions)
    for name, width in WIDTHS.items():
        values = getattr(part, name)
        if name == "texcoords" and values is not None and values.ndim == 2 and values.shape[1] > 0:
            width = 2 * -(-values.shape[1] // 2)  # pairs, one or several
        if values is not None and values.shape != (count, width):
            raise RejectedAsset(f"has {name} of shape {values.shape} where ({count}, {width}) is needed: broken file")
    if part.faces.size and not 0 <= part.faces.min() <= part.faces.max() < count:
        raise RejectedAsset(
            f"has faces that name vertices {part.faces.min()} to {part.faces.max()} of {count}: broken file"
        )


def _check_material(material: Material) -> None:
    """Refuse a material whose channels are not finite values, one or a texture of them."""
    present = [name for name in TEXTURES if getattr(material, name) is not None]
    for name in (*CHANNELS, *present):
        values, inner = getattr(material, name), (3,) * (CHANNELS | TEXTURES)[name]
        rows = values.shape[: values.ndim - len(inner)]
        if values.shape[len(rows) :] != inner or len(rows) not in (0, 2) or not values.size:
            raise RejectedAsset(f"has a material with {name} of shape {values.shape}: broken file")
        if not np.isfinite(values).all():
            raise RejectedAsset(f"has a material whose {name} is not finite (NaN or infinity)")


def _cleaned(part: Part, notes: set[str]) -> list[Part]:
    """The part with just the columns that its material needs; several parts where vertex colours tint a texture."""
    part = _settle_texture(_used_vertices(part), notes)
    part = replace(part, normals=_unit_normals(part, notes), colors=_checked_colors(part, notes))
    if part.colors is None or part.material.base_color.ndim == 1:
        return [part]
    parts, error = split_by_tint(part)
    if error > 1 / 255:
        notes.add("vertex colours that vary within textured faces (one tint per face is used)")
    return [_used_vertices(piece) for piece in parts]


def _used_vertices(part: Part) -> Part:
    """The part with only the vertices that its faces use, in their old order."""
    used, faces = np.unique(part.faces, return_inverse=True)
    kept: dict[str, Any] = {name: getattr(part, name) for name in WIDTHS}
    kept = {name: None if values is None else values[used] for name, values in kept.items()}
    return replace(part, **kept, faces=faces.reshape(-1, 3).astype(np.int64))


def _settle_texture(part: Part, notes: set[str]) -> Part:
    """The part with texture coordinates exactly where its material needs them; a texture without any: its mean."""
    if not part.material.textured:
        return replace(part, texcoords=None)
    if part.texcoords is None:
        notes.add("texture on faces without texture coordinates (its mean is used)")
        material = part.material
        means = material.base_color.reshape(-1, 3).mean(axis=0), material.roughness.mean(), material.metallic.mean()
        base_color, roughness, metallic = (np.asarray(mean, np.float32) for mean in means)
        plain = Material(base_color=base_color, roughness=roughness, metallic=metallic, wrap=material.wrap)
        return replace(part, material=plain)
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


def _checked_colors(part: Part, notes: set[str]) -> np.ndarray | None:
    """The part's vertex colours in [0, 1]; None where they are all white."""
    if part.colors is None or (part.colors == 1).all():
        return None
    if not np.isfinite(part.colors).all():
        raise RejectedAsset("has vertex colours that are not finite (NaN or infinity)")
    if part.colors.min() < 0 or part.colors.max() > 1:
        notes.add("vertex colours outside [0, 1] (clipped)")
    return np.clip(part.colors, 0, 1)


def _identity(material: Material) -> str:
    """A digest of everything that a material says."""
    digest = hashlib.sha256(material.wrap.encode())
    present = [name for name in TEXTURES if getattr(material, name) is not None]
    digest.update(repr((present, material.cutoff if present else None, sorted(material.coordinates.items()))).encode())
    for values in (getattr(material, name) for name in (*CHANNELS, *present)):
        digest.update(repr((values.shape, values.dtype.str)).encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _merge(parts: list[Part]) -> Part:
    """One part of several that agree in material and in having normals; missing colours are white."""
    first = np.cumsum([0, *(len(part.positions) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, first, strict=False)]
    colors = None
    if any(part.colors is not None for part in parts):
        colors = np.concatenate([np.ones_like(p.positions) if p.colors is None else p.colors for p in parts])
    return Part(
        positions=np.concatenate([part.positions for part in parts]),
        faces=np.concatenate(faces),
        material=parts[0].material,
        normals=None if parts[0].normals is None else np.concatenate([part.normals for part in parts]),
        texcoords=None if parts[0].texcoords is None else np.concatenate([part.texcoords for part in parts]),
        colors=colors,
    )
