"""Every reader of other people's files, with small valid files, and the law of what it may return.

`READERS` maps a name to (seeds, read): valid files as dicts from names to bytes, the one that is opened first, and what
reads it in a folder.  That returns when the file was read and what came is sound (finite, right shapes and types),
raises ValueError, one line, when the file is refused, and AssertionError when something unsound was let through.
"""

import contextlib
import dataclasses
import functools
import gzip
import io
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from support import splat_balls, tiny_dataset
from support.gltf_files import UV, GltfBuilder, instanced, png, skinned
from support.mesh_files import TEXTURE, UNIT_UV, two_squares_ply
from support.packed_meshes import draco_square, meshopt_files
from support.point_clouds import packed_splats
from support.point_tables import WHOLE, WRITERS, written

from data_gen.plan import tasks
from data_gen.store import check
from spnr_jax import presets
from spnr_jax.config import SurfelConfig
from spnr_jax.formats import clouds, data_sets, gaussian_files, meshes, surface_points
from spnr_jax.methods import from_dict, to_dict
from spnr_jax.tools import frame
from spnr_jax.training import checkpoint, trainer
from spnr_jax.training.weights import Trained, read_weights, variable_shapes

Files = dict[str, bytes]

MOST_POINTS = 32
TEXELS = np.random.default_rng(7).integers(0, 256, (4, 4, 4))


def read_cloud(folder: Path, main: str) -> None:
    """What `spnr render` and `spnr view` do with a file of points or a mesh."""
    placed = clouds.place_cloud(folder / main, num_points=MOST_POINTS, report=lambda line: None)
    check_cloud(placed.cloud, MOST_POINTS)
    assert np.isfinite(placed.origin).all()
    assert np.linalg.det(placed.rotation) > 0.99


def read_mesh(folder: Path, main: str) -> None:
    """What the generator of data makes of a mesh file, and `spnr render` with either choice of transparent parts."""
    with contextlib.suppress(ValueError):  # more is refused for references than for pictures
        surface_points.sample_surface(meshes.load_mesh(folder / main), MOST_POINTS, 0)
    with contextlib.suppress(ValueError):
        check_cloud(clouds.read_cloud(folder / main, num_points=MOST_POINTS, transparent_parts="skip"), MOST_POINTS)
    read_cloud(folder, main)


def check_cloud(cloud, most: int | None = None) -> None:
    """AssertionError unless the cloud is finite float32 with materials in [0, 1]."""
    count = len(cloud.positions)
    assert 1 <= count <= (most or count), f"{count} points"
    shapes = {"positions": (count, 3), "base_color": (count, 3), "roughness": (count,), "metallic": (count,)}
    for name, shape in shapes.items():
        values = np.asarray(getattr(cloud, name))
        assert values.shape == shape, f"{name} {values.shape}"
        assert values.dtype == np.float32, f"{name} {values.dtype}"
        assert np.isfinite(values).all(), f"{name} not finite"
        assert name == "positions" or 0 <= values.min() <= values.max() <= 1, f"{name} outside of 0 to 1"
    assert cloud.mask.dtype == bool
    assert cloud.mask.all()


def read_config(folder: Path, main: str) -> None:
    """A run folder's config."""
    config = checkpoint.read_config(folder)
    hash(config)  # it is a static argument of jit
    assert from_dict(to_dict(config)) == config, "a config that is not itself again"


def read_metrics(folder: Path, main: str) -> None:
    """The rows that a report draws."""
    for row in trainer.read_rows(folder):
        assert all(isinstance(value, int | float) for value in row.values()), "a row with a value that is no number"


def read_dataset(folder: Path, main: str) -> None:
    """What `spnr-data check` says, and every object of a data set, as training reads it."""
    with contextlib.suppress(ValueError), contextlib.redirect_stdout(io.StringIO()):
        assert isinstance(check.check(folder), bool)
    dataset = data_sets.open_dataset(folder)
    for name in dataset.splits["train"]:
        item = data_sets.read_object(dataset, name)
        check_cloud(item.cloud)
        views, height, width = len(item.camera.cam_to_world), item.camera.height, item.camera.width
        assert views >= 1, "no views"
        for images in (item.images, item.conditions):
            assert (images.shape, images.dtype) == ((views, height, width, 4), np.uint8)
        assert item.camera.cam_to_world.shape == (views, 3, 4)
        assert np.isfinite(item.camera.cam_to_world).all()
        assert np.isfinite(item.camera.intrinsics).all()
        assert (np.asarray(item.camera.intrinsics)[:, (0, 1), (0, 1)] > 0).all(), "a focal length below 0"


def read_list(folder: Path, main: str) -> None:
    """A test split that a user names."""
    assert set(tasks.read_test_list(folder / main, {"a", "b"})) <= {"a", "b"}


def read_network(folder: Path, main: str) -> None:
    """A file of weights."""
    assert isinstance(read_weights(folder / main), Trained)


def read_upload(folder: Path, main: str) -> None:
    """What a browser's file becomes; nothing of it stays on the disk."""
    before, read = set(folder.iterdir()), functools.partial(clouds.read_cloud, num_points=MOST_POINTS, up="auto")
    try:
        name = (folder / "name.txt").read_text("utf-8", errors="replace")
        check_cloud(frame.read_upload(name, (folder / main).read_bytes(), read), MOST_POINTS)
    finally:
        assert set(folder.iterdir()) == before, "a file that stays"


def tables(*suffixes: str) -> list[Files]:
    """One table of points in all the ways that files of these kinds are written."""
    found = []
    for name in (name for name in WRITERS if name.endswith(suffixes)):
        with tempfile.TemporaryDirectory() as folder:
            path = written(Path(folder), name, WHOLE)
            beside = {p.name: p.read_bytes() for p in Path(folder).iterdir() if p != path}
            found.append({name: path.read_bytes()} | beside)
    return found


def plain_meshes(suffix: str) -> list[Files]:
    """A box as trimesh writes it; of .ply also textured squares."""
    box, found = trimesh.creation.box(), []
    if suffix == ".ply":
        box.visual.face_colors = np.tile([40, 170, 60, 255], (len(box.faces), 1))
        by_vertex, faces = "property float s\nproperty float t\n", 2 * [f"{UNIT_UV} 0"]
        squares = two_squares_ply("comment TextureFile a.png\n", by_vertex, TEXTURE, "{0} {1}", faces)
        found = [{"mesh.ply": squares.encode(), "a.png": png(TEXELS[..., :3])}]
    kinds = ("stl", "stl_ascii") if suffix == ".stl" else (suffix[1:],)
    contents = [box.export(file_type=kind) for kind in kinds]
    return [{f"mesh{suffix}": data if isinstance(data, bytes) else data.encode()} for data in contents] + found


def objs() -> list[Files]:
    """A box with two materials, one of them textured and cut out."""
    corners = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1)) + "vt 0 0\nvt 1 0\nvt 1 1\n"
    faces = "mtllib a.mtl\nvn 0 0 1\nusemtl red\nf 1/1/1 2/2/1 4/3/1\nusemtl plain\nf -1 -2 -4 -3\nf 1 2 6 5 3\n"
    library = b"# Blender 4.1 MTL File\nnewmtl red\nNs 9\n"
    library += b"Kd 1 1 1\nmap_Kd -s 1 1 1 -clamp on a.png\nmap_d b.png\nnewmtl plain\nKd 0.1 0.2 0.3\nTr 0.4\n"
    companions = {"a.mtl": library, "a.png": png(TEXELS[..., :3]), "b.png": png(TEXELS)}
    return [{"mesh.obj": (corners + faces).encode()} | companions, *tables(".obj")]


def scene(material: dict, *images: tuple[str, bytes], suffix: str = ".gltf") -> Files:
    """A square of a material under a node, beside an opaque one; the images lie beside the file."""
    builder = GltfBuilder()
    for number, (name, _) in enumerate(images):
        builder.texture(uri=name, wrapS=33071 if number else 10497)
    if images and images[0][0].endswith(".webp"):
        builder.document["textures"][0] = {"extensions": {"EXT_texture_webp": {"source": 0}}}
    square = builder.primitive(material=builder.material(**material), TEXCOORD_0=UV)
    child = builder.mesh(square, root=False, translation=[1, 0, 0])
    builder.node(children=[child], rotation=[0, 0, 0, 1], scale=[1, 2, 1])
    builder.mesh(builder.primitive(), translation=[5, 0, 0])
    builder.node(mesh=0)
    files = {"mesh.glb": builder.glb()} if suffix == ".glb" else builder.files("mesh.gltf")
    return files | dict(images)


def scenes() -> list[Files]:
    """Masks, glass, normal maps, moved textures, the older specular workflow, WebP, points, a skin, instances."""
    webp = io.BytesIO()
    Image.fromarray(TEXELS.astype(np.uint8)).save(webp, "webp", lossless=True)
    pictures = ("a.png", png(TEXELS)), ("b.png", png(TEXELS[..., :3]))
    base = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 0.9]}}
    moved = {"KHR_texture_transform": {"scale": [2, 3], "offset": [0.1, 0], "rotation": 0.3, "texCoord": 0}}
    bumpy = {"normalTexture": {"index": 1, "scale": 0.7, "extensions": moved}}
    look = {"diffuseTexture": {"index": 0}, "specularGlossinessTexture": {"index": 1}}
    shiny = {"KHR_materials_pbrSpecularGlossiness": look}
    glass = {"KHR_materials_transmission": {"transmissionFactor": 0.5}}
    return [
        scene(base | {"alphaMode": "MASK", "alphaCutoff": 0.3} | bumpy, *pictures),
        scene({"extensions": glass} | bumpy, *pictures),
        scene({"extensions": shiny, "emissiveFactor": [0, 0.1, 0], "alphaMode": "BLEND"}, *pictures),
        scene(base, ("a.webp", webp.getvalue())),
        scene({}, suffix=".glb"),
        skinned(inverse=np.eye(4)).files("mesh.gltf"),
        instanced().files("mesh.gltf"),
        *tables(".gltf", ".glb"),
    ]


def splats() -> list[Files]:
    """Packed splats of both versions of .spz, and a compressed .ply."""
    content = gzip.decompress(gaussian_files.spz_of(splat_balls.ball(12)))
    spz = [{"cloud.spz": gzip.compress(content[:4] + bytes([version]) + content[5:], mtime=0)} for version in (2, 3)]
    return [*spz, {"cloud.ply": packed_splats(WHOLE.positions / 8, 255)}]


def configs() -> list[Files]:
    """A config of each preset."""
    return [{"config.json": json.dumps(to_dict(make()), indent=2).encode()} for make in presets.PRESETS.values()]


def datasets() -> list[Files]:
    """A data set of one object, with each of its files as the one that is hit most."""
    with tempfile.TemporaryDirectory() as folder:
        place = tiny_dataset.write_dataset(Path(folder), {"train": ("a",), "val": (), "test": ()}, size=16)
        paths = sorted(path for path in place.rglob("*") if path.is_file())
        files = {path.relative_to(place).as_posix(): path.read_bytes() for path in paths}
    return [{name: files[name]} | files for name in files if "00" not in name or "000" in name]


def weights() -> list[Files]:
    """A file of weights of a very small network."""
    config = dataclasses.replace(presets.surfels_tiny(), model=SurfelConfig(widths=(4, 6), top=4))
    described = np.frombuffer(json.dumps(to_dict(config)).encode(), np.uint8)
    halves = {name: np.zeros(x.shape, np.float16) for name, x in variable_shapes(config).items()}
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, config=described, steps=np.int64(3), **halves)
    return [{"weights.npz": stream.getvalue()}]


def uploads() -> list[Files]:
    """Files that a browser sends, with the name that it gives them."""
    return [{"content": next(iter(files.values())), "name.txt": next(iter(files)).encode()} for files in tables(".ply")]


ROW = json.dumps({"step": 1, "loss": 0.5, "steps_per_second": 2.0}) + "\n"
READERS: dict[str, tuple[Callable[[], list[Files]], Callable[[Path, str], None]]] = {
    **{
        name: (functools.partial(tables, f".{name}"), read_cloud) for name in ("ply", "pcd", "npz", "npy", "las", "laz")
    },
    "text": (functools.partial(tables, ".xyz", ".csv", ".txt"), read_cloud),
    "splats": (splats, read_cloud),
    "mesh-ply": (functools.partial(plain_meshes, ".ply"), read_cloud),
    "mesh-stl": (functools.partial(plain_meshes, ".stl"), read_cloud),
    "off": (lambda: [*plain_meshes(".off"), *tables(".off")], read_cloud),
    "obj": (objs, read_mesh),
    "gltf": (scenes, read_mesh),
    "gltf-packed": (lambda: [draco_square().files("mesh.gltf"), meshopt_files()], read_mesh),
    "config": (configs, read_config),
    "metrics": (lambda: [{"metrics.jsonl": 5 * ROW.encode()}], read_metrics),
    "dataset": (datasets, read_dataset),
    "lists": (lambda: [{"list.txt": b"a\nb\n"}], read_list),
    "viewer-upload": (uploads, read_upload),
    "weights": (weights, read_network),
}
