"""Tints: vertex colours on a texture become few tinted textures, as near to the colours as the report says."""

import numpy as np
import pytest

from spnr_jax.formats.mesh.assets import Material, Part
from spnr_jax.formats.mesh.meshes import split_by_tint

TEXTURE = np.random.default_rng(0).random((3, 4, 3), dtype=np.float32)


def triangles(face_colors):
    """Separate triangles, one colour (3,) or three (3, 3) each."""
    count = len(face_colors)
    look = Material(base_color=TEXTURE, roughness=np.float32(0.5), metallic=np.float32(0))
    return Part(
        positions=np.arange(9 * count, dtype=np.float64).reshape(-1, 3),
        faces=np.arange(3 * count).reshape(-1, 3),
        material=look,
        texcoords=np.zeros((3 * count, 2)),
        colors=np.concatenate([np.broadcast_to(color, (3, 3)) for color in face_colors]),
    )


def test_one_colour_a_face_is_exact_and_every_face_keeps_its_own():
    colors = np.array([[1, 1, 1], [0.588, 0.588, 0.588], [0.1, 0.2, 0.3], [1, 1, 1]])
    parts, error = split_by_tint(triangles(colors))
    assert error == pytest.approx(0, abs=1e-12)
    tint = {tuple(face): part.material.base_color for part in parts for face in part.faces}
    for number, color in enumerate(colors):
        corners = (3 * number, 3 * number + 1, 3 * number + 2)
        np.testing.assert_allclose(tint[corners], TEXTURE * color, atol=1e-6)


def test_a_face_of_several_colours_takes_their_mean_and_reports_the_difference():
    ((part,), error) = split_by_tint(triangles([np.array([[0, 0, 0], [0.3, 0, 0], [0.9, 0, 0]])]))
    np.testing.assert_allclose(part.material.base_color, TEXTURE * np.float32([0.4, 0, 0]), atol=1e-6)
    assert error == pytest.approx(0.5)
