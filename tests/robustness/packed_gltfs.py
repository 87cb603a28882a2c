"""Valid glTF files of what other people's tools write: packed meshes and textures, instances, looks of every kind.

Packed data lies in files of its own, so that damage reaches it as it is.
"""

import io
import json

import numpy as np
from damage import Files
from PIL import Image
from support.packed_meshes import ETC1S_ALPHA, MESHOPT, UASTC
from valid_files import CORNERS, FACES, numbers, png

FLOAT, SHORT = 5126, 5123


def _accessor(count: int, kind: str, component: int = FLOAT, **more) -> dict:
    return {"count": count, "type": kind, "componentType": component, **more}


def _document(**more) -> dict:
    """A document that draws its first mesh once."""
    start = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    return start | more


def _file(document: dict, **companions: bytes) -> Files:
    """The document with buffers and images in files beside it, named as the keywords with a dot for the underscore."""
    return {"cloud.gltf": json.dumps(document).encode()} | {k.replace("_", "."): v for k, v in companions.items()}


def packed() -> list[Files]:
    """Files with Draco, meshopt, KTX2 and WebP data, and instances."""
    return [*_draco(), _meshopt(), *map(_basis, (UASTC, ETC1S_ALPHA)), _webp(), _instances()]


def _draco() -> list[Files]:
    """A mesh packed in the two ways that Draco has."""
    import DracoPy

    name, files = "KHR_draco_mesh_compression", []
    for in_order in (True, False):
        normals = np.tile([0.0, 0.0, 1.0], (len(CORNERS), 1))
        data = DracoPy.encode(CORNERS, FACES.astype(np.uint32), normals=normals, preserve_order=in_order)
        ids = {entry["attribute_type"]: entry["unique_id"] for entry in DracoPy.decode(data).attributes}
        extension = {name: {"bufferView": 0, "attributes": {"POSITION": ids[0], "NORMAL": ids[1]}}}
        primitive = {"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2, "extensions": extension}
        vectors = [_accessor(len(CORNERS), "VEC3") for _ in range(2)]
        document = _document(
            extensionsRequired=[name],
            meshes=[{"primitives": [primitive]}],
            accessors=[*vectors, _accessor(FACES.size, "SCALAR", SHORT)],
            bufferViews=[{"buffer": 0, "byteLength": len(data)}],
            buffers=[{"byteLength": len(data), "uri": "mesh.drc"}],
        )
        files.append(_file(document, mesh_drc=data))
    return files


def _meshopt() -> Files:
    """Packed vertices, directions behind a filter, and the triangles of a grid."""
    name = "EXT_meshopt_compression"
    cases = [MESHOPT[case] for case in ("two blocks of steps, format 1", "directions in 4 bytes", "a grid")]
    views = []
    for number, case in enumerate(cases):
        described = {key: case[key] for key in ("count", "byteStride", "mode", "filter")}
        extension = {name: {"buffer": number, "byteLength": len(case["packed"]), **described}}
        stride = {"byteStride": case["byteStride"]} if number < 2 else {}
        views.append({"buffer": 3, "byteLength": case["count"] * case["byteStride"], "extensions": extension} | stride)
    files = {f"{letter}_bin": case["packed"] for letter, case in zip("abc", cases, strict=True)}
    buffers = [{"byteLength": len(data), "uri": key.replace("_", ".")} for key, data in files.items()]
    positions = _accessor(300, "VEC3", SHORT, bufferView=0, normalized=True)
    primitive = {"attributes": {"POSITION": 0}, "indices": 2}
    small = {"attributes": {"POSITION": 3, "NORMAL": 1}}
    document = _document(
        extensionsRequired=[name],
        meshes=[{"primitives": [primitive, small]}],
        accessors=[
            positions,
            _accessor(6, "VEC3", 5120, bufferView=1, normalized=True),
            _accessor(MESHOPT["a grid"]["count"], "SCALAR", 5125, bufferView=2),
            positions | {"count": 6},
        ],
        bufferViews=views,
        buffers=[*buffers, {"byteLength": 2400, "extensions": {name: {"fallback": True}}}],
    )
    return _file(document, **files)


def _plain(**more) -> tuple[dict, bytes]:
    """A document of the small mesh with texture coordinates, and its buffer."""
    blocks = [CORNERS.tobytes(), FACES.tobytes(), numbers(len(CORNERS), 2).tobytes(), numbers(3, 3).tobytes()]
    starts = np.cumsum([0, *map(len, blocks)]).tolist()
    views = [{"buffer": 0, "byteOffset": at, "byteLength": len(b)} for at, b in zip(starts, blocks, strict=False)]
    document = _document(
        meshes=[{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}]}],
        accessors=[
            _accessor(len(CORNERS), "VEC3", bufferView=0),
            _accessor(FACES.size, "SCALAR", SHORT, bufferView=1),
            _accessor(len(CORNERS), "VEC2", bufferView=2),
            _accessor(3, "VEC3", bufferView=3),
        ],
        bufferViews=views,
        buffers=[{"byteLength": starts[-1], "uri": "data.bin"}],
        **more,
    )
    return document, b"".join(blocks)


def _textured(extension: str, image: str, data: bytes) -> Files:
    """The small mesh with one image that only an extension names."""
    document, binary = _plain(
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        textures=[{"extensions": {extension: {"source": 0}}}],
        images=[{"uri": image.replace("_", ".")}],
    )
    return _file(document, data_bin=binary, **{image: data})


def _basis(data: bytes) -> Files:
    return _textured("KHR_texture_basisu", "a_ktx2", data)


def _webp() -> Files:
    stream = io.BytesIO()
    Image.fromarray((255 * numbers(4, 4, 4)).astype(np.uint8)).save(stream, "webp", lossless=True)
    return _textured("EXT_texture_webp", "a_webp", stream.getvalue())


def _instances() -> Files:
    """The small mesh three times."""
    document, binary = _plain(materials=[{}])
    extension = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 3, "SCALE": 3}}}
    return _file(document | {"nodes": [{"mesh": 0, "extensions": extension}]}, data_bin=binary)


def looks() -> list[Files]:
    """Masks, glass, normal maps with coordinates of their own, the older specular workflow."""
    base = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 0.9]}}
    moved = {"KHR_texture_transform": {"scale": [2, 3], "offset": [0.1, 0], "rotation": 0.3, "texCoord": 0}}
    bumpy = {"normalTexture": {"index": 1, "scale": 0.7, "extensions": moved}}
    shiny = {"KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}, "glossinessFactor": 0.4}}
    materials = [
        base | {"alphaMode": "MASK", "alphaCutoff": 0.3},
        base | {"alphaMode": "BLEND"} | bumpy,
        {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.5}, "KHR_materials_sheen": {}}} | bumpy,
        {"extensions": shiny, "emissiveFactor": [0, 0.1, 0], "alphaMode": "MASK"},
    ]
    files = []
    for material in materials:
        document, binary = _plain(
            materials=[material, {}],
            textures=[{"source": 0, "sampler": 0}, {"source": 1}],
            samplers=[{"wrapS": 33071, "wrapT": 33071}],
            images=[{"uri": "a.png"}, {"uri": "b.png"}],
        )
        primitives = document["meshes"][0]["primitives"]
        primitives.append({"attributes": {"POSITION": 0}, "indices": 1, "material": 1})  # something opaque beside it
        files.append(_file(document, data_bin=binary, a_png=png(), b_png=png(3)))
    return files
