"""Small mesh files, one writer a format: squares of a material, alone or beside an opaque one."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from spnr_jax.errors import UserError
from spnr_jax.formats.meshes import load_mesh
from support.gltf_files import CHECKER, UV, GltfBuilder, png

VERTICES = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
TEXCOORDS = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


def write_obj(folder: Path, text: str, mtl: str | None = None) -> Path:
    """An OBJ file and its library; pictures of the checker lie beside them."""
    for name in ("3d wood.png", "pine.png"):
        (folder / name).write_bytes(png(CHECKER))
    if mtl is not None:
        (folder / "look.mtl").write_text(mtl)
        text = "mtllib look.mtl\n" + text
    (folder / "a.obj").write_text(text)
    return folder / "a.obj"


def refusal(path: Path) -> str:
    """The line in which a mesh file is refused."""
    with pytest.raises(UserError) as caught:
        load_mesh(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def square(builder=None, change=lambda document: None, **primitive) -> GltfBuilder:
    """A scene of a square, after a change."""
    builder = builder or GltfBuilder()
    builder.mesh(builder.primitive(**primitive))
    change(builder.document)
    return builder


def glass(texture=None, **material) -> GltfBuilder:
    """A scene of a square of a material, with a texture of that name."""
    builder = GltfBuilder()
    if texture:
        material["pbrMetallicRoughness"] = {"baseColorTexture": {"index": builder.texture(uri=texture)}}
    return square(builder, material=builder.material(name="glass", **material))


def painted(wrap=10497, surface=None, info=(), **factors):
    """What makes a material with the checker, and perhaps one of roughness and metallic."""

    def make(builder):
        pbr = {"baseColorTexture": {"index": builder.texture(CHECKER, wrapS=wrap, wrapT=10497), **dict(info)}}
        rough = {"metallicRoughnessTexture": {"index": builder.texture(CHECKER), **(surface or {})}}
        return {"pbrMetallicRoughness": pbr | factors | (rough if surface is not None else {})}

    return make


def half_transparent(low=0, high=255) -> np.ndarray:
    """Texels red throughout, whose left half has one alpha and whose right half another."""
    texels = np.zeros((8, 8, 4), np.uint8)
    texels[..., 0] = 255
    texels[..., 3] = np.where(np.arange(8) < 4, low, high)
    return texels


def gltf_leaf(folder: Path, texels=None, factor=1.0, material=(), uv=UV, alone=False) -> Path:
    """A .glb of a square of the material "leaf" and, unless it is alone, an opaque blue one far away."""
    builder = GltfBuilder()
    pbr = {"baseColorFactor": [1, 1, 1, factor]}
    if texels is not None:
        pbr["baseColorTexture"] = {"index": builder.texture(texels, wrapS=33071, wrapT=33071)}
    tested = builder.material(name="leaf", pbrMetallicRoughness=pbr, **dict(material))
    builder.mesh(builder.primitive(material=tested, TEXCOORD_0=uv))
    if not alone:
        blue = builder.material(pbrMetallicRoughness={"baseColorFactor": [0, 0, 1, 1]})
        builder.mesh(builder.primitive(material=blue), translation=[10, 0, 0])
    return builder.write(folder / "two.glb")


def obj_leaf(folder: Path, statement: str, texels=None) -> Path:
    """The same as OBJ and MTL."""
    if texels is not None:
        Image.fromarray(texels).save(folder / "mask.png")
    text = VERTICES + VERTICES.replace("v 0", "v 10").replace("v 1 ", "v 11 ") + TEXCOORDS
    text += "usemtl leaf\nf 1/1 2/2 3/3 4/4\nusemtl plain\nf 5/1 6/2 7/3 8/4\n"
    return write_obj(folder, text, f"newmtl leaf\n{statement}\nnewmtl plain\nKd 0 0 1\n")


RGB, OBJ_FACE = ("red", "green", "blue"), "f 1 2 3 4\n"
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
CORNERS = [" ".join(map(str, corner)) for corner in SQUARE]


def square_ply(kind: str, names, color, corners=SQUARE) -> str:
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "".join(f"property {kind} {name}\n" for name in names)
    rows = "".join(" ".join(map(str, (*corner, *color))) + "\n" for corner in corners)
    faces = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    return head + faces + rows + "3 0 1 2\n3 0 2 3\n"


TWO_SQUARES = VERTICES + VERTICES.replace(" 0\n", " 5\n")
TEXTURE, UNIT_UV = "property list uchar float texcoord\nproperty int texnumber\n", "8 0 0 1 0 1 1 0 1"  # of faces


def two_squares_ply(comments: str, of_vertex: str, of_face: str, vertex: str, faces: list[str]) -> str:
    """A PLY of squares at z 0 and 5 with further properties: `vertex` those of each vertex, {0} its x and {1} its y."""
    head = f"ply\nformat ascii 1.0\n{comments}element vertex 8\n" + "".join(f"property float {x}\n" for x in "xyz")
    head += f"{of_vertex}element face 2\nproperty list uchar int vertex_indices\n{of_face}end_header\n"
    places = [line[2:].split() for line in TWO_SQUARES.splitlines()]
    rows = [" ".join([*place, vertex.format(*place)]) for place in places]
    rows += [f"4 {' '.join(str(4 * i + j) for j in range(4))} {face}" for i, face in enumerate(faces)]
    return head + "\n".join([*rows, ""])


def stl(count: int, tail: bytes = b"", at: np.ndarray = SQUARE[0]) -> bytes:
    """A binary STL file of two triangles."""
    triangles = [at + SQUARE[[0, 1, 2]], at + SQUARE[[0, 2, 3]]]
    body = b"".join(np.append(np.zeros(3), corners).astype("<f4").tobytes() + b"\0\0" for corners in triangles)
    return b"made by a scanner".ljust(80, b"\0") + struct.pack("<I", count) + body + tail
