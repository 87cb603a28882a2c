"""The data sets of others: miniatures of their downloads, found, split, augmented and rendered by the real code."""

import gzip
import json

import numpy as np
import pytest
from support.command_line import spnr_data
from support.gltf_files import CORNERS, SQUARE, UV, GltfBuilder, png

from data_gen.__main__ import parse
from data_gen.plan import sources, tasks
from data_gen.store import layout
from spnr_jax.formats import data_sets
from spnr_jax.formats.assets import RejectedAsset
from spnr_jax.formats.columns import srgb_to_linear
from spnr_jax.formats.meshes import load_mesh

TINY = ["--resolution", 16, "--views", 2, "--points", 64, "--spp", 4, "--visibility-grid", 1]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["abo"], "expected 3dmodels/original/*/*.glb and 3dmodels/metadata/3dmodels.csv.gz"),
        (["shapenet_car"], "expected 02958343/*/models/model_normalized.obj or 02958343/*/model.obj"),
    ],
)
def test_another_folder_is_refused_with_what_was_expected_and_found(options, expected, tmp_path, capsys):
    add(tmp_path, "plane", "a", 2)
    (tmp_path / "03001627" / "empty").mkdir(parents=True)
    for root, found in ((tmp_path, "it holds 02691156, 03001627"), (tmp_path / "absent", "there is no such folder")):
        assert spnr_data("generate", tmp_path / "set", "--preset", *options, "--root", root) == 2
        message = capsys.readouterr().err
        assert expected in message
        assert found in message
        assert message.count("\n") == 1


# Amazon Berkeley Objects

HEADER = "3dmodel_id,path,meshes,materials,textures,images,image_height_max,image_height_min,image_width_max,"
HEADER += "image_width_min,vertices,faces,extent_x,extent_y,extent_z"
PRODUCTS = [f"B07{number:06d}{letter}" for number, letter in enumerate("LL91ABC0")]


def product(number, alpha=None):
    """The bytes of a product: a textured square and one of a flat colour, of muted colours."""
    rng = np.random.default_rng(number)
    scene = GltfBuilder()
    texture = scene.texture(rng.integers(150, 200, (4, 4, 3)))
    look = {"baseColorTexture": {"index": texture}, "baseColorFactor": [1, 0.9, 0.8, 1]}
    wood = scene.material(pbrMetallicRoughness=look, **({"alphaMode": alpha} if alpha else {}))
    paint = scene.material(pbrMetallicRoughness={"baseColorFactor": [*rng.uniform(0.4, 0.6, 3), 1]})
    behind = CORNERS + np.float32([0.2, 0.3, -1])
    scene.mesh(
        scene.primitive(CORNERS, SQUARE, material=wood, TEXCOORD_0=UV),
        scene.primitive(behind, SQUARE, material=paint),
    )
    return scene.glb()


def rows(products):
    measures = "1,2,1,1,4,4,4,4,8,4,1.2,1.3,1.0"
    return "\n".join([HEADER, *(f"{name},{name[-1]}/{name}.glb,{measures}" for name in products)]) + "\n"


def packed(table):
    """The same bytes at any time: test runners compare the names of tests, which hold them."""
    return gzip.compress(table.encode(), mtime=0)


@pytest.fixture(scope="module")
def abo(tmp_path_factory):
    """A root with six good products, a transparent one, a row without a file, and a file without a row."""
    root = tmp_path_factory.mktemp("abo")
    metadata = root / "3dmodels" / "metadata"
    metadata.mkdir(parents=True)
    (metadata / "3dmodels.csv.gz").write_bytes(packed(rows(PRODUCTS)))
    for number, name in enumerate([*PRODUCTS[:-1], "B00EXTRA01"]):
        folder = root / "3dmodels" / "original" / name[-1]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.glb").write_bytes(product(number, "BLEND" if number == 6 else None))
    return root


def test_the_metadata_say_what_a_product_is(abo, tmp_path):
    listed = sources.find_products(abo)
    assert [item.object_id for item in listed] == sorted([*PRODUCTS, "B00EXTRA01"])
    faults = {item.object_id: item.fault for item in listed if item.fault}
    assert faults == {
        "B00EXTRA01": "has no row in 3dmodels.csv.gz",
        PRODUCTS[-1]: f"3dmodels.csv.gz lists it, but there is no file 3dmodels/original/0/{PRODUCTS[-1]}.glb",
    }
    inner = sources.find_products(abo / "3dmodels")
    assert [item.path for item in inner] == [item.path for item in listed]
    (tmp_path / "metadata").mkdir()
    (tmp_path / "original").mkdir()
    (tmp_path / "metadata" / "3dmodels.csv").write_text(rows(PRODUCTS))
    assert [item.object_id for item in sources.find_products(tmp_path)] == sorted(PRODUCTS), "not compressed"


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"not gzip", "cannot be read"),
        (packed(rows(PRODUCTS))[:60], "cannot be read"),
        (packed("3dmodel_id,path\na,A/a.glb\n")[:12] + b"\xff" * 20, "cannot be read"),
        (packed("id,file\nA,B\n"), "line 2: expected columns 3dmodel_id and path"),
        (packed(rows(["B1", "B1"])), "line 3: product B1 is listed twice"),
        *(
            (packed(f"3dmodel_id,path\na,{path}\n"), "no file below")
            for path in ("../../secret.glb", "/etc/a.glb", "A/../../a.glb", "A\\a.glb")
        ),
    ],
)
def test_a_damaged_table_is_one_line(tmp_path, content, expected):
    (tmp_path / "metadata").mkdir()
    (tmp_path / "original").mkdir()
    (tmp_path / "metadata" / "3dmodels.csv.gz").write_bytes(content)
    with pytest.raises(ValueError, match=expected) as caught:
        sources.find_products(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.ci
def test_the_preset_of_abo_makes_the_data_set_with_variants_of_training_products_only(
    abo, generate_here, tmp_path, capsys
):
    out = tmp_path / "set"
    command = [out, "--preset", "abo", "--root", abo, *TINY]
    command += ["--test-objects", 2, "--train-objects", 9, "--colour-variants", 2]
    assert generate_here(*command) == 0
    assert "the paper has 16161 train, 200 test" in capsys.readouterr().err
    splits = data_sets.open_dataset(out).splits
    details = {path.parent.name: json.loads(path.read_text()) for path in (out / "objects").glob("*/object.json")}
    rejected = [json.loads(line)["id"] for line in (out / "rejected.jsonl").read_text().splitlines()]
    assert rejected == sorted(["B00EXTRA01", PRODUCTS[-1], PRODUCTS[6]])
    assert [len(splits[split]) for split in layout.SPLITS] == [9, 0, 2]
    assert sorted(splits["train"] + splits["test"]) == sorted(details)
    of_split = {split: {details[name]["product"] for name in ids} for split, ids in splits.items()}
    assert not of_split["train"] & of_split["test"]
    assert of_split["train"] | of_split["test"] == set(PRODUCTS[:6])
    assert sum(details[name]["variant"] > 0 for name in splits["train"]) == 5
    for name in splits["test"]:
        assert details[name]["variant"] == 0
        assert details[name]["colour_rotation"] is None
    settings = json.loads((out / "dataset.json").read_text())["settings"]
    assert (settings["preset"], settings["source"], settings["colour_variants"]) == ("abo", "abo", 2)
    name = next(name for name in splits["train"] if details[name]["variant"])
    check_variant(out, details[name])


def check_variant(out, details):
    """The variant's colours are its product's, rotated; its views and points are its own."""
    dataset = data_sets.open_dataset(out)
    original, variant = (data_sets.read_object(dataset, details[key]) for key in ("product", "id"))
    matrix = np.array(details["colour_rotation"]["matrix"])
    assert (original.camera.cam_to_world != variant.camera.cam_to_world).any()
    means = [item.cloud.base_color.mean(axis=0) for item in (original, variant)]
    np.testing.assert_allclose(means[1], matrix @ means[0], atol=0.03)
    assert np.abs(means[1] - means[0]).max() > 0.03


# ShapeNetCore

TEXELS = np.random.default_rng(2).integers(60, 200, (4, 4, 3))
# as the converters wrote them: doubled faces, an unused texture coordinate, a face group, several kinds of statement
OBJ = """# File produced by Open Asset Import Library
mtllib {mtl}

v -0.3 -0.1 0.2
v 0.3 -0.1 0.2
v 0.3  0.1 0.2
v -0.3 0.1 -0.2
vt 0 0 0
vt 1 0 0
vt 1 1 0
vt 0 1 0
vn 0 0 1
vn 0 0 -1

g mesh1
usemtl material_0_24
f  1/1/1 2/2/1 3/3/1
f  1/1/1 3/3/1 4/4/1
g mesh2
usemtl material_1_24
f  3/3/2 2/2/2 1/1/2
f  1/1/1 2/2/1 4/4/1
"""
MTL = """newmtl material_0_24
Kd 0.8 0.8 0.8
Ka 0 0 0
Ks 0.4 0.4 0.4
Ke 0 0 0
Ns 10
illum 2
map_Kd {image}

newmtl material_1_24
Kd 0.2 0.3 0.6
Ka 0 0 0
Ks 0.4 0.4 0.4
Ke 0 0 0
Ns 10
d 1.000
illum 2
"""
PLACES = {2: ("models/model_normalized", "../images/texture 0.jpg"), 1: ("model", "./images/texture 0.jpg")}


def add(root, category, name, version, image=None):
    """Write one object in the layout of a version; its folder."""
    stem, named = PLACES[version]
    folder = root / sources.SYNSETS[category] / name
    mesh = folder / f"{stem}.obj"
    mesh.parent.mkdir(parents=True)
    (folder / "images").mkdir()
    mesh.write_text(OBJ.format(mtl=f"{mesh.stem}.mtl"))
    mesh.with_suffix(".mtl").write_text(MTL.format(image=image or named))
    (folder / "images" / "texture 0.jpg").write_bytes(png(TEXELS))
    return folder


def load(folder):
    (item,) = [item for item in sources.find_objects(folder.parent, "car") if item.folder == folder]
    return load_mesh(item.path, item.folder)


@pytest.mark.parametrize("version", [1, 2])
def test_both_layouts_give_the_same_object_with_its_texture_and_without_doubled_faces(tmp_path, version):
    asset = load(add(tmp_path, "car", "abc", version))
    textured, plain = sorted(asset.parts, key=lambda part: -part.material.base_color.ndim)
    np.testing.assert_allclose(textured.material.base_color, srgb_to_linear(TEXELS / 255), atol=1e-6)
    np.testing.assert_array_equal(plain.material.base_color, np.float32([0.2, 0.3, 0.6]))
    assert (len(textured.faces), len(plain.faces)) == (2, 1)
    assert asset.ignored == ("1 doubled faces (one of each is kept)", "MTL Kd beside map_Kd")
    assert textured.material.roughness == pytest.approx(np.sqrt(2 / 12))
    corners = np.concatenate([part.positions for part in asset.parts])
    np.testing.assert_allclose(corners.max(axis=0), [0.3, 0.1, 0.2], err_msg="the axes are left as they lie")


@pytest.mark.parametrize(
    "name", ["../../other/images/x.jpg", "../../../x.jpg", "/etc/x.jpg", "..", "../images/../../x"]
)
def test_a_texture_outside_the_objects_folder_is_refused(tmp_path, name):
    (tmp_path / "02958343" / "other" / "images").mkdir(parents=True)
    (tmp_path / "02958343" / "other" / "images" / "x.jpg").write_bytes(png(TEXELS))
    folder = add(tmp_path, "car", "abc", 2, image=name)
    with pytest.raises(RejectedAsset, match="outside its own folder"):
        load(folder)


def test_the_folder_is_wider_for_objects_of_shapenet_only_and_a_link_does_not_lead_a_parent_step_elsewhere(tmp_path):
    folder = add(tmp_path, "car", "abc", 2)
    with pytest.raises(RejectedAsset, match="outside its own folder"):
        load_mesh(folder / "models" / "model_normalized.obj")
    elsewhere = tmp_path / "elsewhere" / "models"
    elsewhere.parent.mkdir()
    (folder / "models").rename(elsewhere)
    (elsewhere.parent / "images").mkdir()
    (elsewhere.parent / "images" / "texture 0.jpg").write_bytes(png(255 - TEXELS))
    (folder / "models").symlink_to(elsewhere)
    colours = [part.material.base_color for part in load(folder).parts if part.material.base_color.ndim == 3]
    np.testing.assert_allclose(colours[0], srgb_to_linear(TEXELS / 255), atol=1e-6)


def test_a_split_file_of_shapenet_makes_those_objects_only_and_an_option_overrides_the_preset(tmp_path):
    root = tmp_path / "ShapeNetCore"
    for number in range(3):
        add(root, "car", f"{number:032x}", 2)
    rows = [f"{number:06d},02958343,02958343,{number:032x},{split}" for number, split in enumerate(("train", "test"))]
    (tmp_path / "all.csv").write_text("\n".join(["id,synsetId,subSynsetId,modelId,split", *rows]))
    options = ["--root", root, "--split-file", tmp_path / "all.csv", "--colour-variants", 1]
    arguments = [str(word) for word in ("generate", "out", "--preset", "shapenet_car", *options)]
    made = tasks.plan_data_set(parse(arguments))
    split = made.split([task.object_id for task in made.tasks])
    assert split == {"train": [f"{0:032x}"], "val": [], "test": [f"{1:032x}"]}
    assert [variant.object_id for variant in made.variants(split["train"])] == [f"{0:032x}--1"]
