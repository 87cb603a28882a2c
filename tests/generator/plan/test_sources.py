"""The data sets of others: miniatures of their downloads, found, split, augmented and rendered by the real code."""

import json

import numpy as np
import pytest
from support.command_line import spnr_data
from support.gltf_files import CORNERS, SQUARE, UV, GltfBuilder, png

from data_gen.plan import sources
from data_gen.store import layout
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.meshes import load_mesh
from spnr_jax.kernels.imaging import srgb_to_linear

TINY = ["--resolution", 16, "--views", 2, "--points", 64, "--spp", 4, "--visibility-grid", 1]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["abo"], "expected 3dmodels/original/*/*.glb"),
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


def ids(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return {identifier: str(path.relative_to(folder)) for identifier, path in sources.find_meshes(folder)}


def test_ids_are_stems_or_the_folder_of_a_lone_obj_or_gltf(tmp_path):
    found = ids(tmp_path, "b.glb", "a.PLY", "pan/model.obj", "pan/model.mtl", "lamp/scene.gltf", "x/cup.glb")
    expected = {"a": "a.PLY", "b": "b.glb", "cup": "x/cup.glb", "lamp": "lamp/scene.gltf", "pan": "pan/model.obj"}
    assert list(found.items()) == list(expected.items())


def test_ids_are_unique_even_where_letter_case_and_cleaning_collide(tmp_path):
    found = ids(tmp_path, "a b.glb", "a_b.glb", "a?b.glb", "A_B.GLB", "ä.off", "ö.off", "a_b.glb.ply")
    assert len(found) == 7
    assert len({name.casefold() for name in found}) == 7
    assert all(set(name) <= set("abcdefghijklmnopqrstuvwxyzABGLP._-0123456789") for name in found)
    assert all(name[0] not in "._-" for name in found)


def test_no_id_is_that_of_a_variant(tmp_path):
    found = ids(tmp_path, "chair.glb", "chair--1.glb", "chair-1.glb")
    assert len(found) == 3
    assert not any("--" in name for name in found)


# Amazon Berkeley Objects

PRODUCTS = [f"B07{number:06d}{letter}" for number, letter in enumerate("LL91ABC")]


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


@pytest.mark.ci
def test_the_preset_of_abo_makes_the_data_set_with_variants_of_training_products_only(generate_here, tmp_path, capsys):
    for number, name in enumerate(PRODUCTS):
        folder = tmp_path / "abo" / "3dmodels" / "original" / name[-1]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.glb").write_bytes(product(number, "BLEND" if number == 6 else None))
    found = [sources.find_products(root) for root in (tmp_path / "abo", tmp_path / "abo" / "3dmodels")]
    assert found[0] == found[1]
    assert [item.object_id for item in found[0]] == sorted(PRODUCTS)
    out = tmp_path / "set"
    command = [out, "--preset", "abo", "--root", tmp_path / "abo", *TINY]
    command += ["--test-objects", 2, "--train-objects", 9, "--colour-variants", 2]
    assert generate_here(*command) == 0
    assert "the paper has 16161 train, 200 test" in capsys.readouterr().err
    splits = data_sets.open_dataset(out).splits
    details = {path.parent.name: json.loads(path.read_text()) for path in (out / "objects").glob("*/object.json")}
    rejected = [json.loads(line)["id"] for line in (out / "rejected.jsonl").read_text().splitlines()]
    assert rejected == [PRODUCTS[6]]
    assert [len(splits[split]) for split in layout.SPLITS] == [9, 0, 2]
    assert sorted(splits["train"] + splits["test"]) == sorted(details)
    of_split = {split: {details[name]["product"] for name in ids} for split, ids in splits.items()}
    assert not of_split["train"] & of_split["test"]
    assert of_split["train"] | of_split["test"] == set(PRODUCTS[:6])
    assert sum(details[name]["variant"] > 0 for name in splits["train"]) == 5
    assert {(details[name]["variant"], details[name]["colour_rotation"]) for name in splits["test"]} == {(0, None)}
    settings = json.loads((out / "dataset.json").read_text())["settings"]
    assert (settings["preset"], settings["source"], settings["colour_variants"]) == ("abo", "abo", 2)
    check_variant(out, next(details[name] for name in splits["train"] if details[name]["variant"]))


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
Ks 0.4 0.4 0.4
Ns 10
illum 2
map_Kd {image}

newmtl material_1_24
Kd 0.2 0.3 0.6
Ks 0.4 0.4 0.4
Ns 10
d 1.000
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


def test_the_folder_is_wider_for_objects_of_shapenet_only_and_neither_names_nor_links_lead_outside(tmp_path):
    folder = add(tmp_path, "car", "abc", 2)
    with pytest.raises(UserError, match="names a file that is missing"):
        load_mesh(folder / "models" / "model_normalized.obj")
    elsewhere = tmp_path / "elsewhere" / "models"
    elsewhere.parent.mkdir()
    (folder / "models").rename(elsewhere)
    (elsewhere.parent / "images").mkdir()
    (elsewhere.parent / "images" / "texture 0.jpg").write_bytes(png(255 - TEXELS))
    (folder / "models").symlink_to(elsewhere)
    colours = [part.material.base_color for part in load(folder).parts if part.material.base_color.ndim == 3]
    np.testing.assert_allclose(colours[0], srgb_to_linear(TEXELS / 255), atol=1e-6)
    for name in ("../../other/images/x.jpg", "../../../x.jpg", "/etc/x.jpg", "..", "../images/../../x"):
        elsewhere.joinpath("model_normalized.mtl").write_text(MTL.format(image=name))
        with pytest.raises(UserError, match="names a file that is missing"):
            load(folder)
