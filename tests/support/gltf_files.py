"""Small glTF files for tests, written with nothing of data_gen."""

import io
import json
import struct

import numpy as np
from PIL import Image

from spnr_jax.formats.meshes import load_mesh

COMPONENT = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
KIND = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)  # a square that faces +z
SQUARE = np.array([0, 1, 2, 0, 2, 3], np.uint16)


def png(texels) -> bytes:
    """An 8-bit PNG of texels (height, width, channels)."""
    stream = io.BytesIO()
    Image.fromarray(np.asarray(texels, np.uint8)).save(stream, "png")
    return stream.getvalue()


class GltfBuilder:
    """A glTF document under construction: one node per mesh unless the test says otherwise."""

    def __init__(self, **document):
        self.document = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "meshes": [], "nodes": []}
        self.document |= {"scene": 0, "scenes": [{"nodes": []}], **document}
        self.binary = b""

    def view(self, data: bytes) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.document["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)})
        self.binary += data
        return len(self.document["bufferViews"]) - 1

    def accessor(self, array, **more) -> int:
        array = np.asarray(array)
        entry = {
            "componentType": COMPONENT[array.dtype.str[1:]],
            "count": len(array),
            "type": KIND[1 if array.ndim == 1 else array.shape[1]],
        }
        self.document["accessors"].append({"bufferView": self.view(array.tobytes()), **entry, **more})
        return len(self.document["accessors"]) - 1

    def texture(self, texels=None, uri=None, **sampler) -> int:
        """Number of a new texture, embedded from texels or named by a URI."""
        images = self.document.setdefault("images", [])
        images.append({"uri": uri} if uri else {"bufferView": self.view(png(texels)), "mimeType": "image/png"})
        self.document.setdefault("samplers", []).append(sampler)
        textures = self.document.setdefault("textures", [])
        textures.append({"source": len(images) - 1, "sampler": len(images) - 1})
        return len(textures) - 1

    def material(self, **material) -> int:
        self.document.setdefault("materials", []).append(material)
        return len(self.document["materials"]) - 1

    def primitive(self, positions=CORNERS, indices=SQUARE, *, material=None, mode=None, **attributes) -> dict:
        primitive = {"attributes": {"POSITION": self.accessor(positions)}}
        primitive["attributes"] |= {name: self.accessor(values) for name, values in attributes.items()}
        more = {"indices": None if indices is None else self.accessor(indices), "material": material, "mode": mode}
        return primitive | {name: value for name, value in more.items() if value is not None}

    def mesh(self, *primitives, **node) -> int:
        """Number of a new root node that draws the primitives."""
        self.document["meshes"].append({"primitives": list(primitives)})
        return self.node(mesh=len(self.document["meshes"]) - 1, **node)

    def node(self, *, root=True, **node) -> int:
        self.document["nodes"].append(node)
        index = len(self.document["nodes"]) - 1
        if root:
            self.document["scenes"][0]["nodes"].append(index)
        return index

    def glb(self) -> bytes:
        self.document["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        binary = self.binary + b"\0" * (-len(self.binary) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def write(self, path):
        """Write a .glb, or a .gltf with its buffer beside it in data.bin; the path."""
        files = {path.name: self.glb()} if path.suffix == ".glb" else self.files(path.name)
        for name, content in files.items():
            (path.parent / name).write_bytes(content)
        return path

    def files(self, name: str, *more_buffers: dict) -> dict[str, bytes]:
        """The document under a name, and its buffer beside it; further buffers are described alone."""
        self.document["buffers"] = [{"byteLength": len(self.binary), "uri": "data.bin"}, *more_buffers]
        return {name: json.dumps(self.document).encode(), "data.bin": self.binary}


UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # upright: v runs down the picture
CHECKER = np.random.default_rng(0).integers(0, 256, (4, 6, 3))


def one_square(tmp_path, builder=None, node=None, **primitive):
    builder = builder or GltfBuilder()
    builder.mesh(builder.primitive(**primitive), **(node or {}))
    return load_mesh(builder.write(tmp_path / "square.glb"))


def skinned(joints=((0, 0, 0, 0),) * 4, armature=None, inverse=None, **node) -> GltfBuilder:
    """A scene of a square that hangs on one joint of a moved armature, half of its weights written."""
    builder = GltfBuilder()
    weights = np.tile(np.float32([0.5, 0, 0, 0]), (4, 1))
    primitive = builder.primitive(
        JOINTS_0=np.array(joints, np.uint8), WEIGHTS_0=weights, NORMAL=np.tile(np.float32([0, 0, 1]), (4, 1))
    )
    builder.mesh(primitive, skin=0, **node)
    joint = builder.node(root=False, name="hip")
    builder.node(children=[joint], **(armature or {}))
    skin = {"joints": [joint]}
    if inverse is not None:
        skin["inverseBindMatrices"] = builder.accessor(np.float32(inverse).T.reshape(1, 16))
    builder.document["skins"] = [skin]
    return builder


def instanced(**node) -> GltfBuilder:
    """A scene of a square that is drawn twice: moved, and moved and turned."""
    builder = GltfBuilder(extensionsRequired=["EXT_mesh_gpu_instancing"])
    moves = {
        "TRANSLATION": np.float32([[1, 0, 0], [0, 5, 0]]),
        "ROTATION": np.array([[0, 0, 0, 127], [0, 127, 0, 0]], "i1"),
    }
    attributes = {name: builder.accessor(values) for name, values in moves.items()}
    builder.document["accessors"][-1]["normalized"] = True
    instances = {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}}
    builder.mesh(builder.primitive(), **instances, **node)
    return builder
