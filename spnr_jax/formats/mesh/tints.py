"""Vertex colours on top of a base-colour texture, folded into tinted copies of the texture.

A renderer takes either a texture or colours at vertices, so a textured part with vertex colours becomes one part per
tint. Exact for faces of one colour (the common case: an exporter's constant, or white); a face whose corners differ
takes their mean, and more than MAX_TINTS colours are gathered into fewer: `split_by_tint` says how far off that is.
"""

from dataclasses import replace

import numpy as np

from spnr_jax.formats.mesh.assets import Part

MAX_TINTS = 16  # tinted copies of a texture
LEVELS = (255, 31, 15, 7, 3, 1)  # steps per channel that tell tints apart; the first that needs few enough copies


def split_by_tint(part: Part) -> tuple[list[Part], float]:
    """Parts without vertex colours that look like this one, and the largest error of a colour at a face's corner."""
    assert part.colors is not None, "only parts with vertex colours are split"
    corners = part.colors[part.faces]
    face_colors = corners.mean(axis=1)
    for levels in LEVELS:
        steps, group = np.unique(np.round(face_colors * levels), axis=0, return_inverse=True)
        if len(steps) <= MAX_TINTS:
            break
    members = [group.ravel() == number for number in range(len(steps))]
    tints = [face_colors[here].mean(axis=0) for here in members]
    error = max(np.abs(corners[here] - tint).max() for here, tint in zip(members, tints, strict=True))
    return [_tinted(part, here, tint) for here, tint in zip(members, tints, strict=True)], float(error)


def _tinted(part: Part, faces: np.ndarray, tint: np.ndarray) -> Part:
    """The chosen faces (f,) bool of a part with its texture multiplied by a colour (3,)."""
    material = replace(part.material, base_color=part.material.base_color * tint.astype(np.float32))
    return replace(part, faces=part.faces[faces], material=material, colors=None)
