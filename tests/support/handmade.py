"""Small assets made by hand, whose pictures and points a test can predict."""

import numpy as np

from spnr_jax.formats.assets import Asset, Material, Part

WHITE_LIGHT = np.ones((8, 16, 3), np.float32)  # from everywhere
RED, GREEN, BLUE, GREY = (0.7, 0.05, 0.05), (0.05, 0.6, 0.05), (0.05, 0.05, 0.7), (0.5, 0.5, 0.5)


def plain(color=GREY, roughness=0.8, metallic=0.0) -> Material:
    channels = [np.asarray(value, np.float32) for value in (color, roughness, metallic)]
    return Material(base_color=channels[0], roughness=channels[1], metallic=channels[2])


def box(centre=(0, 0, 0), half=(0.5, 0.5, 0.5), material=None, texcoords=False) -> Part:
    """Six sides of two triangles each, in the order -x +x -y +y -z +z, counter-clockwise from outside."""
    corners = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    sides = [np.roll(np.insert(corners, 0, sign, axis=1), axis, axis=1) for axis in range(3) for sign in (-1, 1)]
    faces = np.array([[[0, 3, 2], [0, 2, 1]], [[0, 1, 2], [0, 2, 3]]] * 3) + 4 * np.arange(6)[:, None, None]
    return Part(
        positions=np.concatenate(sides) * half + centre,
        faces=faces.reshape(-1, 3),
        material=material or plain(),
        texcoords=np.tile((corners + 1) / 2, (6, 1)) if texcoords else None,
    )


def ball(centre=(0, 0, 0), radius=0.5, material=None, rows=12) -> Part:
    """A smooth sphere of latitude-longitude triangles."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1), indexing="ij")
    normals = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1).reshape(-1, 3)
    row, column = np.divmod(np.arange(rows * 2 * rows), 2 * rows)
    first = row * (2 * rows + 1) + column
    below = first + 2 * rows + 1
    upper, lower = np.stack([first, below, below + 1], 1), np.stack([first, below + 1, first + 1], 1)
    faces = np.concatenate([upper[row < rows - 1], lower[row > 0]])
    return Part(
        positions=normals * radius + centre, faces=faces.astype(np.int64), material=material or plain(), normals=normals
    )


def enclosed_volume(positions, faces) -> float:
    """Volume within a closed surface whose faces are counter-clockwise from outside."""
    a, b, c = np.asarray(positions)[faces.T]
    return np.einsum("fk,fk->", a, np.cross(b, c)) / 6


def checked_box_and_ball() -> Asset:
    """A box with a checked texture and a red ball beside it, within the unit sphere."""
    squares = (np.indices((8, 8)).sum(0) % 2).astype(np.float32)
    checks = Material(
        base_color=np.where(squares[..., None] > 0, np.float32(GREEN), np.float32(GREY)).astype(np.float32),
        roughness=0.3 + 0.4 * squares,
        metallic=np.float32(0.0),
    )
    parts = box((-0.3, 0, 0), (0.35, 0.5, 0.4), checks, texcoords=True), ball((0.55, -0.15, 0), 0.35, plain(RED, 0.3))
    return Asset(parts=parts, category="handmade")
