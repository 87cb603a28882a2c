"""Valid glTF files of what other people's tools write: packed meshes and textures, instances, looks of every kind.

Packed images lie in files of their own, so that damage reaches them as they are.
"""

import io

import numpy as np
from damage import Files
from PIL import Image
from support.gltf_files import GltfBuilder
from support.packed_meshes import ETC1S_ALPHA, MESHOPT, UASTC
from valid_files import CORNERS, FACES, numbers, png

FLOAT, SHORT = 5126, 5123


def packed() -> list[Files]:
    """Files with Draco, meshopt, KTX2 and WebP data, and instances."""
    return [*map(_draco, (True, False)), _meshopt(), *map(_basis, (UASTC, ETC1S_ALPHA)), _webp(), _instances()]


def _draco(in_order: bool) -> Files:
    """A mesh packed in one of the two ways that Draco has."""
    import DracoPy

    name, normals = "KHR_draco_mesh_compression", np.tile([0.0, 0.0, 1.0], (len(CORNERS), 1))
    data = DracoPy.encode(CORNERS, FACES.astype(np.uint32), normals=normals, preserve_order=in_order)
    ids = {entry["attribute_type"]: entry["unique_id"] for entry in DracoPy.decode(data).attributes}
    builder = GltfBuilder(extensionsRequired=[name])
    extension = {name: {"bufferView": builder.view(data), "attributes": {"POSITION": ids[0], "NORMAL": ids[1]}}}
    vectors = {"count": len(CORNERS), "type": "VEC3", "componentType": FLOAT}
    indices = {"count": FACES.size, "type": "SCALAR", "componentType": SHORT}
    builder.document["accessors"] = [vectors, vectors, indices]
    builder.mesh({"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2, "extensions": extension})
    return builder.files("cloud.gltf")


def _meshopt() -> Files:
    """Packed vertices, directions behind a filter, and the triangles of a grid."""
    name = "EXT_meshopt_compression"
    builder = GltfBuilder(extensionsRequired=[name])
    views = builder.document["bufferViews"]
    for case in (MESHOPT[key] for key in ("two blocks of steps, format 1", "directions in 4 bytes", "a grid")):
        described = {key: case[key] for key in ("count", "byteStride", "mode", "filter")}
        extension = views[builder.view(case["packed"])] | described
        views[-1] = {"buffer": 1, "byteLength": case["count"] * case["byteStride"], "extensions": {name: extension}}
        if case["mode"] == "ATTRIBUTES":
            views[-1]["byteStride"] = case["byteStride"]
    positions = {"bufferView": 0, "count": 300, "type": "VEC3", "componentType": SHORT, "normalized": True}
    normals = {"bufferView": 1, "count": 6, "type": "VEC3", "componentType": 5120, "normalized": True}
    indices = {"bufferView": 2, "count": MESHOPT["a grid"]["count"], "type": "SCALAR", "componentType": 5125}
    builder.document["accessors"] = [positions, normals, indices, positions | {"count": 6}]
    small = {"attributes": {"POSITION": 3, "NORMAL": 1}}
    builder.mesh({"attributes": {"POSITION": 0}, "indices": 2}, small)
    return builder.files("cloud.gltf", {"byteLength": 2400, "extensions": {name: {"fallback": True}}})


def _square(builder: GltfBuilder, material: int) -> dict:
    """The small mesh with texture coordinates."""
    return builder.primitive(CORNERS, FACES.ravel(), material=material, TEXCOORD_0=numbers(len(CORNERS), 2))


def _textured(extension: str, image: str, data: bytes) -> Files:
    """The small mesh with one image that only an extension names."""
    builder = GltfBuilder()
    texture = builder.texture(uri=image)
    builder.document["textures"][texture] = {"extensions": {extension: {"source": 0}}}
    material = builder.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
    builder.mesh(_square(builder, material))
    return builder.files("cloud.gltf") | {image: data}


def _basis(data: bytes) -> Files:
    return _textured("KHR_texture_basisu", "a.ktx2", data)


def _webp() -> Files:
    stream = io.BytesIO()
    Image.fromarray((255 * numbers(4, 4, 4)).astype(np.uint8)).save(stream, "webp", lossless=True)
    return _textured("EXT_texture_webp", "a.webp", stream.getvalue())


def _instances() -> Files:
    """The small mesh three times."""
    builder = GltfBuilder()
    places = builder.accessor(numbers(3, 3))
    extension = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places, "SCALE": places}}}
    builder.mesh(_square(builder, builder.material()), extensions=extension)
    return builder.files("cloud.gltf")


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
        builder = GltfBuilder()
        builder.texture(uri="a.png", wrapS=33071, wrapT=33071)
        builder.texture(uri="b.png")
        opaque = builder.primitive(CORNERS, FACES.ravel(), material=1)  # beside what is not
        builder.mesh(_square(builder, builder.material(**material)), opaque)
        builder.material()
        files.append(builder.files("cloud.gltf") | {"a.png": png(), "b.png": png(3)})
    return files
