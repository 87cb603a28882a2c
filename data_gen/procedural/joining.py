"""From pieces to an object: meshes that share a finish become one part, standing on y = 0.

A piece is (finish, mesh) in metres or any other unit; families of objects return lists of them.
"""

from data_gen.shapes.finishes import Finish
from data_gen.shapes.primitives import Mesh, merge
from spnr_jax.formats.mesh.assets import Asset, Part

Piece = tuple[Finish, Mesh]
DECIMALS = 6  # of positions and normals: hides the last bit, in which the sines of two processors may differ


def assemble(pieces: list[Piece], category: str, source: dict) -> Asset:
    """Asset with one part per finish, in order of first use, its lowest point at y = 0."""
    floor = min(mesh.positions[:, 1].min() for _, mesh in pieces)
    finishes = list({id(finish): finish for finish, _ in pieces}.values())
    parts = []
    for finish in finishes:
        mesh = merge([mesh for other, mesh in pieces if other is finish])
        parts.append(
            Part(
                positions=(mesh.positions - (0, floor, 0)).round(DECIMALS),
                faces=mesh.faces,
                material=finish.material,
                normals=mesh.normals.round(DECIMALS),
                texcoords=(mesh.texcoords / finish.tile).round(DECIMALS),
            )
        )
    return Asset(parts=tuple(parts), category=category, source=source)
