"""Valid files of every kind that is read, as small as can be: what tests/robustness/test_fuzz.py damages.

A seed is a dict from names to bytes, the file that is opened first, its companions behind it.  All seeds follow from
literal seeds; damage to a few hundred bytes hits what matters.
"""

import gzip
import io
import struct
from collections.abc import Sequence

import numpy as np
from damage import Files
from support import gltf_files, pcd_files, splat_balls
from support.gltf_files import GltfBuilder
from support.point_clouds import packed_splats

from spnr_jax.formats import gaussian_files

SIZE, VIEWS, POINTS = 8, 2, 12
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 4], [1, 2, 4]], np.uint16)


def numbers(*shape: int) -> np.ndarray:
    """Numbers in [0, 1), always the same."""
    return np.random.default_rng(7).random(shape).astype(np.float32)


def png(channels: int = 4) -> bytes:
    """A picture of 4 x 4 pixels."""
    return gltf_files.png(255 * numbers(4, 4, channels))


def ply(form: str, columns: Sequence[tuple[str, str]], faces: bool = False) -> bytes:
    """A PLY file of points with these (type, name), or of a small mesh."""
    codes = {"float": "f4", "uchar": "u1", "double": "f8", "int": "i4"}
    order = ">" if "big" in form else "<"
    count = len(CORNERS) if faces else POINTS
    head = ["ply", f"format {form} 1.0", "comment made", f"element vertex {count}"]
    head += [f"property {kind} {name}" for kind, name in columns]
    head += [f"element face {len(FACES)}", "property list uchar int vertex_indices"] if faces else []
    table = np.zeros(count, [(name, order + codes[kind]) for kind, name in columns])
    for i, (kind, name) in enumerate(columns):
        table[name] = (
            CORNERS[:, i % 3] if faces and i < 3 else numbers(count, 16)[:, i] * (255 if kind == "uchar" else 1)
        )
    header = ("\n".join([*head, "end_header"]) + "\n").encode()
    if form == "ascii":
        rows = [" ".join(f"{value:g}" for value in row) for row in table.tolist()]
        rows += [f"3 {a} {b} {c}" for a, b, c in FACES] if faces else []
        return header + ("\n".join(rows) + "\n").encode()
    triples = b"".join(struct.pack(f"{order}Biii", 3, *face) for face in FACES.tolist()) if faces else b""
    return header + table.tobytes() + triples


XYZ = [("float", "x"), ("float", "y"), ("float", "z")]
RGB = [("uchar", "red"), ("uchar", "green"), ("uchar", "blue")]
PBR = [("float", f"base_color_{c}") for c in "rgb"] + [("float", "roughness"), ("float", "metallic")]
SPLAT = [*XYZ, *(("float", f"f_dc_{i}") for i in range(3)), ("float", "opacity"), ("float", "scale_0")]


def plys() -> list[Files]:
    """PLY files of points: text, both byte orders, splats."""
    forms = ("ascii", "binary_little_endian", "binary_big_endian")
    found = [{"cloud.ply": ply(form, XYZ + more)} for form in forms for more in (RGB, PBR)]
    found += [{"cloud.ply": ply(form, SPLAT)} for form in forms[:2]]
    return [*found, {"cloud.ply": packed_splats(CORNERS, 0x28AA3CFF)}]


def ply_meshes() -> list[Files]:
    """PLY files with faces."""
    return [{"cloud.ply": ply(form, XYZ + RGB, faces=True)} for form in ("ascii", "binary_little_endian")]


def pcds() -> list[Files]:
    """PCD files: text, binary, compressed."""
    return [{"cloud.pcd": pcd_files.content(kind, pcd_files.points())} for kind in pcd_files.ENCODINGS]


def texts() -> list[Files]:
    """Text files of points: with and without names, commas and blanks."""
    rows = numbers(POINTS, 9)
    found = {"cloud.xyz": ("", " ", 3), "b/cloud.xyz": ("", " ", 6), "cloud.txt": ("", " ", 9)}
    found |= {"cloud.csv": ("x,y,z,r,g,b\n", ",", 6), "b/cloud.csv": ("# x;y;z;intensity\n", ";", 4)}
    found |= {"cloud.pts": (f"{POINTS}\n", " ", 7), "b/cloud.txt": ("//X;Y;Z;R;G;B\n", ";", 6)}
    files = [{"cloud.csv": "\n".join(";".join(f"{v:g}".replace(".", ",") for v in row[:6]) for row in rows).encode()}]
    for name, (header, mark, width) in found.items():
        lines = "\n".join(mark.join(f"{v:g}" for v in row[:width]) for row in rows)
        files.append({name.removeprefix("b/"): f"{header}{lines}\n".encode()})
    return files


def npzs() -> list[Files]:
    """NPZ archives, packed and not."""
    arrays = {"positions": numbers(POINTS, 3), "colors": (255 * numbers(POINTS, 3)).astype(np.uint8)}
    arrays["roughness"] = numbers(POINTS)
    files = []
    for save in (np.savez, np.savez_compressed):
        stream = io.BytesIO()
        save(stream, allow_pickle=False, **arrays)
        files.append({"cloud.npz": stream.getvalue()})
    return files


def npys() -> list[Files]:
    """NPY arrays: plain and of named fields."""
    named = np.zeros(POINTS, [("x", "f4"), ("y", "f4"), ("z", "f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    named["x"], named["z"] = numbers(2, POINTS)
    files = []
    for array in (numbers(POINTS, 6), named, np.asfortranarray(numbers(POINTS, 3))):
        stream = io.BytesIO()
        np.save(stream, array, allow_pickle=False)
        files.append({"cloud.npy": stream.getvalue()})
    return files


def scans(suffix: str) -> list[Files]:
    """Laser scans through laspy, of two point formats."""
    import laspy

    files = []
    for point_format in (2, 6):
        scan = laspy.LasData(laspy.LasHeader(point_format=point_format, version="1.4"))
        scan.x, scan.y, scan.z = numbers(3, POINTS).astype(np.float64)
        scan.intensity = np.arange(POINTS)
        stream = io.BytesIO()
        scan.write(stream, do_compress=suffix == "laz")
        files.append({f"cloud.{suffix}": stream.getvalue()})
    return files


def stls() -> list[Files]:
    """STL meshes, text and binary."""
    facet = "facet normal 0 0 1\nouter loop\n{}endloop\nendfacet\n"
    loops = ["".join("vertex {:g} {:g} {:g}\n".format(*CORNERS[i]) for i in face) for face in FACES]
    text = "solid a\n" + "".join(map(facet.format, loops)) + "endsolid a\n"
    binary = bytes(80) + struct.pack("<I", len(FACES))
    binary += b"".join(np.concatenate([[[0, 0, 1]], CORNERS[face]]).astype("<f4").tobytes() + b"\0\0" for face in FACES)
    return [{"cloud.stl": text.encode()}, {"cloud.stl": binary}]


def offs() -> list[Files]:
    """OFF meshes, plain and with colours."""
    rows = ["{:g} {:g} {:g}".format(*corner) for corner in CORNERS]
    faces = ["3 {} {} {}".format(*face) for face in FACES]
    size = f"{len(CORNERS)} {len(FACES)} 0"
    colored = [f"{row} 255 0 0 255" for row in rows]
    return [{"cloud.off": "\n".join(["OFF", size, *rows, *faces, ""]).encode()},
            {"cloud.off": "\n".join(["OFF", f"{len(CORNERS)} 0 0", *rows, ""]).encode()},
            {"cloud.off": "\n".join(["COFF", size, *colored, *faces, ""]).encode()}]  # fmt: skip


def spzs() -> list[Files]:
    """Packed splats of both versions that are read."""
    content = gzip.decompress(gaussian_files.spz_of(splat_balls.ball(POINTS)))
    return [{"cloud.spz": gzip.compress(content[:4] + bytes([version]) + content[5:])} for version in (2, 3)]


def objs() -> list[Files]:
    """OBJ meshes: bare, and with a library and a texture."""
    rows = ["v {:g} {:g} {:g}".format(*corner) for corner in CORNERS]
    bare = [*rows, *("f {} {} {}".format(*(face + 1)) for face in FACES), "f -1 -2 -3 -4", ""]
    texcoords = [f"vt {u} {v}" for u, v in ((0, 0), (1, 0), (1, 1))]
    faces = ["f {}/1/1 {}/2/1 {}/3/1".format(*(face + 1)) for face in FACES]
    rich = ["mtllib a.mtl", *rows, *texcoords, "vn 0 0 1", "usemtl red", *faces[:2], "usemtl plain", *faces[2:], ""]
    library = "newmtl red\nKd 1 1 1\nmap_Kd -s 1 1 1 -clamp on a.png\nd 1.0\n"
    library += "newmtl plain\nKd 0.1 0.2 0.3\nNs 90\nPm 0.5\nTr 0\n"
    holes = library.replace("Tr 0", "d 0.4").replace("d 1.0", "map_d b.png")
    points = [*(f"{row} 0.1 0.5 1" for row in rows), "p 1 2 3", ""]
    return [{"cloud.obj": "\n".join(bare).encode()},
            {"cloud.obj": "\n".join(points).encode()},
            {"cloud.obj": "\n".join(rich).encode(), "a.mtl": holes.encode(), "a.png": png(3), "b.png": png()},
            {"cloud.obj": "\n".join(rich).encode(), "a.mtl": library.encode(), "a.png": png(3)}]  # fmt: skip


def _gltf(**image) -> GltfBuilder:
    """A textured mesh with moved corners under a node that stretches it; the image is embedded or a file."""
    builder = GltfBuilder()
    color = {"index": builder.texture(**image, wrapS=10497)}
    material = builder.material(pbrMetallicRoughness={"baseColorTexture": color, "roughnessFactor": 0.5})
    square = builder.primitive(CORNERS, FACES.ravel(), material=material, TEXCOORD_0=numbers(len(CORNERS), 2))
    rows, values = builder.view(np.array([0, 3], np.uint16).tobytes()), builder.view(CORNERS[:2].tobytes())
    sparse = {"count": 2, "indices": {"bufferView": rows, "componentType": 5123}, "values": {"bufferView": values}}
    builder.document["accessors"][0]["sparse"] = sparse
    child = builder.mesh(square, root=False, translation=[1, 0, 0])
    builder.node(children=[child], rotation=[0, 0, 0, 1], scale=[1, 2, 1])
    return builder


def gltfs() -> list[Files]:
    """A glTF document with a buffer and a texture beside it."""
    return [_gltf(uri="a.png").files("cloud.gltf") | {"a.png": png()}]


def glbs() -> list[Files]:
    """GLB files with all inside: a textured mesh, and points."""
    points = GltfBuilder()
    points.mesh(points.primitive(CORNERS, mode=0, COLOR_0=numbers(len(CORNERS), 4)), scale=[1, 2, 1])
    return [{"cloud.glb": _gltf(texels=255 * numbers(4, 4, 4)).glb()}, {"cloud.glb": points.glb()}]
