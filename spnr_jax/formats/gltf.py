"""glTF 2.0 scenes, .gltf or .glb, as parts: one per primitive of a node or instance; skins in the pose of the nodes.

Not read through trimesh, which leaves integers unscaled and drops fans (docs/lab/readers.md); tests compare with it.

base colour = factor x texture (sRGB -> linear); roughness = factor x G, metallic = factor x B of the metallic-roughness
texture; defaults white, 1, 1. KHR_materials_pbrSpecularGlossiness is converted with the formulas of the extension's
reference converter.  A material has the texture coordinates of its first texture; a texture with other coordinates is
replaced by its mean.  Features that are not modelled are listed in `ignored`.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spnr_jax.errors import UserError
from spnr_jax.formats import assets
from spnr_jax.formats.assets import RGB, Loading, Material, Part, Texels, Wrap
from spnr_jax.formats.columns import LONGEST_NAME, Columns
from spnr_jax.formats.gltf_file import DRACO, MESHOPT, GltfFile
from spnr_jax.kernels.imaging import srgb_to_linear
from spnr_jax.kernels.triangles import strip_faces

LOOSE = {"POINTS", "LINES", "LINE_LOOP", "LINE_STRIP"}
MODES = dict(enumerate(("POINTS", "LINES", "LINE_LOOP", "LINE_STRIP", "TRIANGLES", "TRIANGLE_STRIP", "TRIANGLE_FAN")))
WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
NEAREST = 9728
BASIS, WEBP, MOVED = "KHR_texture_basisu", "EXT_texture_webp", "KHR_texture_transform"
INSTANCES, VISIBILITY, SPLATS = "EXT_mesh_gpu_instancing", "KHR_node_visibility", "KHR_gaussian_splatting"
READ = {MOVED, WEBP, BASIS, DRACO, *MESHOPT, INSTANCES, VISIBILITY, SPLATS, "KHR_mesh_quantization"}
LIGHTS = "KHR_lights_punctual"  # ignored, with a note
HARMLESS = {  # do not change the picture
    *("KHR_animation_pointer", "KHR_xmp_json_ld", "EXT_structural_metadata", "EXT_mesh_features"),
    *("KHR_node_hoverability", "KHR_node_selectability", "VRM", "VRMC_vrm"),
}
MATERIALS = "KHR_materials_"  # prefix; the ones that are not modelled are listed in `ignored`
MOTION, SKIN = {"TRANSLATION": (0, 0, 0), "ROTATION": (0, 0, 0, 1), "SCALE": (1, 1, 1)}, ("JOINTS_", "WEIGHTS_")
SPECULAR_GLOSSINESS, UNLIT = "KHR_materials_pbrSpecularGlossiness", "KHR_materials_unlit"
TRANSPARENT = {"transmission": "transmissionFactor", "diffuse_transmission": "diffuseTransmissionFactor"}
DIELECTRIC = 0.04  # reflectance of a non-metal at normal incidence
SRGB_WRITERS = ("trimesh", "Open3D")  # write vertex colours as sRGB, where the format has linear ones
# texels instead of a missing image: grey 0.5; roughness 0.5, metallic 0; specular 0.04, glossiness 0.5; flat
GREY, DULL, GLOSS, FLAT = (188, 188, 188, 255), (255, 128, 0, 255), (56, 56, 56, 128), (128, 128, 255, 255)
# Limit of vertices and faces in repeated meshes, because a small file could ask for any number; each repetition costs
# as much as PLACING faces.
MOST_REPEATED, PLACING = 2**23, 64
REPEATS = f"repeats its meshes more than can be read ({MOST_REPEATED} vertices and faces)"


def load_gltf(path: Path, loading: Loading) -> list[Part]:
    """The triangles of the default scene with their materials, in file order."""
    file, ignored = GltfFile(path, loading), loading.ignored
    document = file.document
    for extension in document.get("extensionsRequired", []):
        if extension not in READ | HARMLESS | {LIGHTS} and not extension.startswith(MATERIALS):
            raise UserError(f"needs {extension}, which cannot be read: export it without that extension")
    drawn = list(list_primitives(file))
    modes = {id(primitive): MODES[primitive.get("mode", 4)] for primitive, *_ in drawn}
    # points are read if there are no triangles
    wanted = "POINTS" if not loading.strict and modes and set(modes.values()) <= LOOSE else "TRIANGLE"
    ignored |= {"animations"} & document.keys()
    others = {*document.get("extensionsUsed", [])} - READ - HARMLESS
    ignored |= {name for name in others if not name.startswith(MATERIALS)}
    read_look = cache(partial(read_material, file))
    shapes: dict[int, tuple[Columns, np.ndarray]] = {}  # by id of the primitive, which the document keeps alive
    parts, repeated = [], 0
    for primitive, matrix, joints in drawn:
        if not (mode := modes[id(primitive)]).startswith(wanted):
            ignored.add(f"{mode} primitives")
            continue
        if "POSITION" not in primitive["attributes"]:
            ignored.add("primitives without positions")
            continue
        extensions = primitive.get("extensions", {})
        if SPLATS in extensions:
            raise UserError(f"holds Gaussian splats ({SPLATS}), which are not read: convert it to .ply or .spz")
        ignored |= {"KHR_materials_variants"}.intersection(extensions)
        ignored |= {f"attribute {name[:LONGEST_NAME]}" for name in primitive["attributes"] if name.startswith("_")}
        ignored |= {"morph targets"} if primitive.get("targets") else set()
        number, key = primitive.get("material"), id(primitive)
        material, placement = read_look(number)
        if material is None:
            continue
        if key in shapes:
            repeated += len(shapes[key][0]["POSITION"]) + len(shapes[key][1]) + PLACING
        else:
            shapes[key] = _shape(file, primitive, mode, f"TEXCOORD_{placement.texcoord_set}")
        if repeated > MOST_REPEATED:
            raise UserError(REPEATS)
        columns, faces = shapes[key]
        asks_alpha = number is not None and document["materials"][number].get("alphaMode", "OPAQUE") != "OPAQUE"
        if joints is not None:
            bent = _bend(columns, joints)
            ignored |= {"skins of vertices that name no joints"} if bent is None else set()
            matrix = matrix if bent is None else bent
        part = _place(columns, faces, material, placement, matrix)
        if (asks_alpha or mode == "POINTS") and "COLOR_0" in columns and columns["COLOR_0"][:, 3:].min(initial=1) < 1:
            ignored |= {"alpha of vertex colours"} if asks_alpha else set()
            part = replace(part, alpha=columns["COLOR_0"][:, 3])
        parts.append(part)
    return parts


def list_primitives(file: GltfFile) -> Iterator[tuple[dict, np.ndarray, np.ndarray | None]]:
    """(primitive, matrix to world (4, 4), its skin's joint matrices (j, 4, 4) or None) of the default scene.

    Every primitive of each node's mesh and of each of its instances, depth first.
    """
    document = file.document
    nodes, world = document.get("nodes", []), dict[int, np.ndarray]()
    if scenes := document.get("scenes"):
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    else:
        roots = sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})
    stack = [(root, np.eye(4), True) for root in reversed(roots)]
    shown: list[int] = []
    while stack:
        index, parent, visible = stack.pop()
        if index in world:
            raise UserError(f"its node {index} is reached twice: the scene is not a tree")
        node = nodes[index]
        own = {name: np.array([node[name.lower()]], np.float64) for name in MOTION if name.lower() in node}
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T if "matrix" in node else _matrices(own)[0]
        world[index] = parent @ matrix
        visible &= node.get("extensions", {}).get(VISIBILITY, {}).get("visible", True)
        shown += [index] if visible and "mesh" in node else []
        stack += [(child, world[index], visible) for child in reversed(node.get("children", []))]
    joints_of, placed = cache(lambda skin: _joints(file, document["skins"][skin], world)), 0
    for index in shown:
        node, joints, moves = nodes[index], None, Columns()
        if "skin" in node:  # the node's own matrix does not apply to skinned meshes
            joints = joints_of(node["skin"])
        elif INSTANCES in node.get("extensions", {}):
            moves = file.columns(node["extensions"][INSTANCES]["attributes"], *MOTION)
        if (placed := placed + _count(moves)) > MOST_REPEATED / PLACING:
            raise UserError(REPEATS)
        for matrix in world[index] @ _matrices(moves):
            for primitive in document["meshes"][node["mesh"]]["primitives"]:
                yield primitive, matrix, joints


def _count(moves: Columns) -> int:
    return max(map(len, moves.values()), default=1)


def _matrices(moves: Columns) -> np.ndarray:
    """Matrices (n, 4, 4) of scales, then rotations (x, y, z, w), then translations; one identity without any."""
    count = _count(moves)
    if any(len(move) != count for move in moves.values()):
        raise UserError("has instances with several numbers of places, turns or sizes: broken file")
    translation, rotation, scale = (moves.get(name, np.tile(plain, (count, 1))) for name, plain in MOTION.items())
    rotation = np.where(rotation.any(axis=1, keepdims=True), rotation, MOTION["ROTATION"])
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, :3, :3] = Rotation.from_quat(rotation).as_matrix() * scale[:, None]
    matrices[:, :3, 3] = translation
    return matrices


def _joints(file: GltfFile, skin: dict, world: dict[int, np.ndarray]) -> np.ndarray:
    """The skinning matrices (j, 4, 4) of a skin's joints: world matrix times inverse bind matrix."""
    joints = np.stack([world.get(joint, np.eye(4)) for joint in skin["joints"]])
    if "inverseBindMatrices" in skin:
        inverse = file.accessor(skin["inverseBindMatrices"]).astype(np.float64)
        if len(inverse) < len(joints):
            raise UserError(f"has {len(joints)} joints in a skin and {len(inverse)} matrices of them: broken file")
        joints = joints @ np.swapaxes(inverse[: len(joints)].reshape(-1, 4, 4), 1, 2)
    elsewhere = [joint not in world for joint in skin["joints"]]  # in another scene: identity
    return np.where(np.array(elsewhere)[:, None, None], np.eye(4), joints)


def _bend(columns: Columns, joints: np.ndarray) -> np.ndarray | None:
    """Linear blend skinning: matrices (v, 4, 4) of the vertices, of four or more joints each; None without joints."""
    parts = [[columns[name] for name in sorted(columns) if name.startswith(of)] for of in SKIN]
    if not all(parts):
        return None
    numbers, weights = np.concatenate(parts[0], axis=1), np.concatenate(parts[1], axis=1).astype(np.float64)
    if numbers.shape != weights.shape:
        raise UserError("has a skin with other numbers of joints than of weights: broken file")
    numbers = np.where(weights > 0, numbers, 0).astype(np.int64)  # joints with weight 0 may have any number
    if numbers.min(initial=0) < 0 or numbers.max(initial=0) >= len(joints):
        raise UserError(f"has vertices on joint {numbers.max()} of {len(joints)}: broken file")
    weights[weights.sum(axis=1) <= 0, 0] = 1
    weights /= weights.sum(axis=1, keepdims=True)
    return sum(weights[:, i, None, None] * joints[numbers[:, i]] for i in range(numbers.shape[1]))


def _shape(file: GltfFile, primitive: dict, mode: str, texcoords: str) -> tuple[Columns, np.ndarray]:
    """The vertex columns (v, width) in use and the faces (f, 3) of a primitive, in its own frame."""
    if DRACO in primitive.get("extensions", {}):
        file.unpack_mesh(primitive)
        mode = "TRIANGLES"  # Draco stores triangles, whatever the mode was
    attributes = primitive["attributes"]
    wanted = ("POSITION", "NORMAL", "COLOR_0", texcoords, *(name for name in attributes if name.startswith(SKIN)))
    count = len(file.accessor(attributes["POSITION"]))
    order, used = np.arange(count), None
    if "indices" in primitive:
        order = file.accessor(primitive["indices"])[:, 0].astype(np.int64)
        kept, places = np.unique(order, return_inverse=True)
        counts = {file.document["accessors"][index]["count"] for name, index in attributes.items() if name in wanted}
        if counts == {count} and len(kept) < count and 0 <= kept.min(initial=0) <= kept.max(initial=0) < count:
            order, used = places, kept  # the other vertices belong to other primitives
    columns = file.columns(attributes, *wanted, rows=used)
    generator = str(file.document["asset"].get("generator"))
    writer = next((name for name in SRGB_WRITERS if name in generator), None)
    if "COLOR_0" in columns and writer:
        columns["COLOR_0"][:, :3] = srgb_to_linear(columns["COLOR_0"][:, :3])
        file.loading.say(f"vertex colours taken as sRGB, as {writer} writes them")
    if mode == "POINTS":
        return {name: values[order] for name, values in columns.items()}, np.zeros((0, 3), np.int64)
    if mode == "TRIANGLE_STRIP":
        return columns, strip_faces(order)
    if mode == "TRIANGLE_FAN":
        return columns, np.stack([order[1:-1], order[2:], np.repeat(order[:1], max(0, len(order) - 2))], axis=-1)
    return columns, order[: len(order) // 3 * 3].reshape(-1, 3)


def _place(columns: Columns, faces: np.ndarray, material: Material, place: "Placement", matrix: np.ndarray) -> Part:
    """The part of a primitive in world space, by one matrix (4, 4) or one per vertex (v, 4, 4)."""
    linear = matrix[..., :3, :3]
    mirrored = np.linalg.det(linear) < 0
    side = -1 if 2 * np.sum(mirrored) > np.size(mirrored) else 1
    # cofactor matrix: a multiple of the inverse transpose, also defined for singular matrices
    cofactors = np.cross(np.roll(linear, -1, axis=-2), np.roll(linear, -2, axis=-2))
    normals, colors, texcoords = (columns.get(name) for name in ("NORMAL", "COLOR_0", f"TEXCOORD_{place.texcoord_set}"))
    return Part(
        positions=_transform(columns["POSITION"], linear) + matrix[..., :3, 3],
        faces=faces[:, ::side],
        material=material,
        normals=None if normals is None else _transform(normals, cofactors) * side,
        texcoords=None if texcoords is None else texcoords @ np.array(place.turn).T + np.array(place.offset),
        colors=None if colors is None else colors[:, :3],
    )


def _transform(vectors: np.ndarray, linear: np.ndarray) -> np.ndarray:
    return vectors @ linear.T if linear.ndim == 2 else (linear @ vectors[..., None])[..., 0]


# --- materials --------------------------------------------------------------------------------------------------------


class Placement(NamedTuple):
    """Texture coordinates: a set of the file, transformed by uv @ turn.T + offset; tuples, so that == works."""

    wrap: Wrap = "repeat"
    texcoord_set: int = 0
    turn: tuple = ((1.0, 0.0), (0.0, 1.0))
    offset: tuple = (0.0, 0.0)


def _read_texture(
    file: GltfFile, places: list[Placement], info: dict | None, stand_in: tuple[int, ...]
) -> Texels | None:
    """Texels of a textureInfo, or `stand_in` (4,) for a missing image.

    Its placement is appended to the material's `places`; if that differs from the first, the texture's mean is
    returned.
    """
    if info is None:
        return None
    texels = _read_image(file, info["index"]) or Texels(np.array(stand_in, np.uint8).reshape(1, 1, 4))
    places.append(_placement(file, info))
    if places[-1] == places[0]:
        return texels
    file.loading.ignored.add("second texture with its own coordinates (its mean is used)")
    return Texels(texels.encoded.mean(axis=(0, 1), keepdims=True).round().astype(np.uint8))


def _read_image(file: GltfFile, index: int) -> Texels | None:
    """Texels of texture `index`; None if its image is missing."""
    texture = file.document["textures"][index]
    extensions = texture.get("extensions", {})
    webp, basis = (extensions.get(name, {}).get("source") for name in (WEBP, BASIS))
    source = next((number for number in (webp, texture.get("source"), basis) if number is not None), None)
    if source is None:
        file.loading.go_on_without("has a texture that cannot be read", ", ".join(extensions) or "no image")
        return None
    image = file.document["images"][source]
    if "uri" in image:
        return file.loading.read_image(image["uri"])
    return file.loading.read_image(f"image {source}", file.view(image["bufferView"]))


def _placement(file: GltfFile, info: dict[str, Any]) -> Placement:
    """The placement of a texture; rotations are counter-clockwise with v downwards (KHR_texture_transform)."""
    texture = file.document["textures"][info["index"]]
    sampler = file.document["samplers"][texture["sampler"]] if "sampler" in texture else {}
    wrap, wrap_t = (WRAPS[sampler.get(axis, 10497)] for axis in ("wrapS", "wrapT"))
    if wrap != wrap_t:
        file.loading.ignored.add(f"wrapT {wrap_t} (wrapS {wrap} is used for both)")
    if sampler.get("magFilter") == NEAREST:
        file.loading.ignored.add("nearest-texel filter (bilinear is used)")
    moved = info.get("extensions", {}).get(MOVED, {})
    cos, sin = np.cos(moved.get("rotation", 0.0)), np.sin(moved.get("rotation", 0.0))
    turn = np.array([[cos, sin], [-sin, cos]]) * np.asarray(moved.get("scale", (1, 1)), np.float64)
    x, y = moved.get("offset", (0, 0))
    number = moved.get("texCoord", info.get("texCoord", 0))
    return Placement(wrap, number, tuple(map(tuple, turn.tolist())), (float(x), float(y)))


def read_material(file: GltfFile, index: int | None) -> tuple[Material | None, Placement]:
    """Material `index` of a file (None if it is invisible everywhere) and the placement of its textures.

    Index None: glTF's default, a rough metal, for references; for a picture, a white dielectric.
    """
    loading, spec = file.loading, {} if index is None else file.document["materials"][index]
    if index is None and not loading.strict:
        spec = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.5}}
        loading.say("parts without a material: roughness 0.5 and metallic 0 taken")
    name, extensions = str(spec.get("name", f"number {index}")), spec.get("extensions", {})
    places: list[Placement] = []
    read = partial(_read_texture, file, places)
    glossy = extensions.get(SPECULAR_GLOSSINESS)
    look, of_color = (spec.get("pbrMetallicRoughness", {}), "baseColor") if glossy is None else (glossy, "diffuse")
    if UNLIT in extensions and not loading.strict and "metallicRoughnessTexture" not in look:  # means no metal
        look = {"metallicFactor": 0.0, "roughnessFactor": 0.5} | look
    color, factor = read(look.get(f"{of_color}Texture"), GREY), look.get(f"{of_color}Factor", (1, 1, 1, 1))
    base_color = _scaled(color, RGB, factor[:3], "sRGB")
    if glossy is None:
        surface = read(look.get("metallicRoughnessTexture"), DULL)
        metallic = _scaled(surface, 2, look.get("metallicFactor", 1.0))
        roughness = _scaled(surface, 1, look.get("roughnessFactor", 1.0))
    else:
        surface = read(look.get("specularGlossinessTexture"), GLOSS)
        specular = _scaled(surface, RGB, look.get("specularFactor", (1, 1, 1)), "sRGB")
        base_color, metallic = metallic_roughness(base_color, specular)
        roughness = 1 - _scaled(surface, 3, look.get("glossinessFactor", 1.0))
    # after the textures, because a missing file is the clearer error
    material = assets.make_material(base_color, roughness, metallic)
    shown = loading.cut_out(name, material, *_alpha(spec, color, (*factor, 1.0)[3]))
    if UNLIT in extensions:
        light = "colours that hold light already (KHR_materials_unlit) taken as base colours"
        loading.say(light, about=repr(name[:LONGEST_NAME]))
    loading.ignored |= extensions.keys() - {SPECULAR_GLOSSINESS} | (spec.keys() & {"occlusionTexture"})
    loading.ignored |= {"emissive"} if any(spec.get("emissiveFactor", ())) else set()
    if loading.strict:
        loading.ignored |= spec.keys() & {"normalTexture"}
    elif (bumps := read(spec.get("normalTexture"), FLAT)) is not None and shown is not None:
        scale = float(spec["normalTexture"].get("scale", 1.0))
        shown = replace(shown, normal_map=_scaled(bumps, RGB, np.array([scale, scale, 1], np.float32), "direction"))
    placement = [*places, Placement()][0]
    return shown and replace(shown, wrap=placement.wrap), placement


def _scaled(texels: Texels | None, channels: int | tuple[int, ...], factor: Any, curve: str = "linear") -> np.ndarray:
    """The factor, times the values of channels of texels, if any."""
    factor = np.asarray(factor) if isinstance(factor, np.ndarray) else np.asarray(factor, np.float64)
    if texels is None or not factor.any():
        return factor
    values = texels.values(channels, curve)
    return values if (factor == 1).all() else values * factor


def metallic_roughness(diffuse: np.ndarray, specular: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """base_color (*n, 3) and metallic (*n,) of linear diffuse and specular colours, (3,) or images of two sizes."""
    if diffuse.ndim == specular.ndim == 3:
        size = tuple(map(max, diffuse.shape[:2], specular.shape[:2]))
        diffuse, specular = (assets.resize(texels, *size) for texels in (diffuse, specular))
    bright_diffuse, bright_specular = (np.sqrt((x * x) @ np.array([0.299, 0.587, 0.114])) for x in (diffuse, specular))
    share = (1 - specular.max(axis=-1)) / (1 - DIELECTRIC)  # of the light that is not reflected specularly
    b = bright_diffuse * share + bright_specular - 2 * DIELECTRIC
    discriminant = np.maximum(b * b - 4 * DIELECTRIC * (DIELECTRIC - bright_specular), 0)
    metallic = np.clip((-b + np.sqrt(discriminant)) / (2 * DIELECTRIC), 0, 1)
    metallic = np.where(bright_specular < DIELECTRIC, 0, metallic)[..., None]
    from_diffuse = diffuse * share[..., None] / np.maximum(1 - metallic, 1e-6)
    from_specular = (specular - DIELECTRIC * (1 - metallic)) / np.maximum(metallic, 1e-6)
    base_color = from_diffuse + (from_specular - from_diffuse) * metallic**2
    return np.clip(base_color, 0, 1), metallic[..., 0]


def _alpha(spec: dict, color: Texels | None, factor: float | int) -> tuple[str, np.ndarray, float | None]:
    """The statement that makes a material transparent ("": opaque), its alpha () or (h, w), and a mask's cut-off."""
    mode, extensions = spec.get("alphaMode", "OPAQUE"), spec.get("extensions", {})
    for name, entry in TRANSPARENT.items():
        if extensions.get(f"KHR_materials_{name}", {}).get(entry, 0) > 0:
            return f"KHR_materials_{name}", np.zeros(()), None
    if mode == "OPAQUE":
        return "", np.ones(()), None
    cutoff = float(spec.get("alphaCutoff", 0.5)) if mode == "MASK" else None
    return f"alphaMode {mode}", _scaled(color, 3, factor), cutoff
