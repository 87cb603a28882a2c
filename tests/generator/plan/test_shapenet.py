"""ShapeNetCore: miniatures of both layouts, found, split and rendered by the real code."""

import json

import numpy as np
import pytest
from support.command_line import spnr_data
from support.gltf_files import png

from data_gen.__main__ import parse
from data_gen.plan import sources, tasks
from data_gen.store import layout
from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.formats.mesh.texels import srgb_to_linear

pytestmark = pytest.mark.ci  # it renders several data sets

TINY = ["--resolution", 16, "--views", 2, "--points", 64, "--spp", 4, "--visibility-grid", 1, "--workers", 2]
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
d {opacity}
illum 2
"""
PLACES = {2: ("models/model_normalized", "../images/texture 0.jpg"), 1: ("model", "./images/texture 0.jpg")}


def add(root, category, name, version, opacity="1.000", texture=True, image=None):
    """Write one object in the layout of a version; its folder."""
    stem, named = PLACES[version]
    folder = root / sources.SYNSETS[category] / name
    mesh = folder / f"{stem}.obj"
    mesh.parent.mkdir(parents=True)
    (folder / "images").mkdir()
    mesh.write_text(OBJ.format(mtl=f"{mesh.stem}.mtl"))
    mesh.with_suffix(".mtl").write_text(MTL.format(image=image or named, opacity=opacity))
    if texture:
        (folder / "images" / "texture 0.jpg").write_bytes(png(TEXELS))
    return folder


def download(root, category, version, count=6):
    """A class of good objects, one without its texture, a transparent one, and one without a mesh."""
    for number in range(count):
        add(root, category, f"{number:032x}", version)
    add(root, category, "e" * 32, version, texture=False)
    add(root, category, "f" * 32, version, opacity="0.4")
    (root / sources.SYNSETS[category] / "meshless" / "models").mkdir(parents=True)
    return root


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


def test_the_axes_are_left_as_they_lie(tmp_path):
    asset = load(add(tmp_path, "car", "abc", 2))
    corners = np.concatenate([part.positions for part in asset.parts])
    np.testing.assert_allclose(corners.max(axis=0), [0.3, 0.1, 0.2])


@pytest.mark.parametrize(
    "name", ["../../other/images/x.jpg", "../../../x.jpg", "/etc/x.jpg", "..", "../images/../../x"]
)
def test_a_texture_outside_the_objects_folder_is_refused(tmp_path, name):
    (tmp_path / "02958343" / "other" / "images").mkdir(parents=True)
    (tmp_path / "02958343" / "other" / "images" / "x.jpg").write_bytes(png(TEXELS))
    folder = add(tmp_path, "car", "abc", 2, image=name)
    with pytest.raises(RejectedAsset, match="outside its own folder"):
        load(folder)


def test_the_folder_is_wider_for_objects_of_shapenet_only(tmp_path):
    folder = add(tmp_path, "car", "abc", 2)
    with pytest.raises(RejectedAsset, match="outside its own folder"):
        load_mesh(folder / "models" / "model_normalized.obj")


def test_a_link_does_not_lead_a_parent_step_elsewhere(tmp_path):
    folder = add(tmp_path, "car", "abc", 2)
    elsewhere = tmp_path / "elsewhere" / "models"
    elsewhere.parent.mkdir()
    (folder / "models").rename(elsewhere)
    (elsewhere.parent / "images").mkdir()
    (elsewhere.parent / "images" / "texture 0.jpg").write_bytes(png(255 - TEXELS))
    (folder / "models").symlink_to(elsewhere)
    colours = [part.material.base_color for part in load(folder).parts if part.material.base_color.ndim == 3]
    np.testing.assert_allclose(colours[0], srgb_to_linear(TEXELS / 255), atol=1e-6)


def test_the_root_may_be_the_class_itself_and_other_classes_are_not_read(tmp_path):
    add(tmp_path, "plane", "a", 2)
    add(tmp_path, "chair", "b", 1)
    for root in (tmp_path, tmp_path / "02691156"):
        assert [item.object_id for item in sources.find_objects(root, "plane")] == ["a"]
    assert [item.object_id for item in sources.find_objects(tmp_path, "chair")] == ["b"]


def test_another_folder_is_refused_with_what_was_expected_and_found(tmp_path, capsys):
    add(tmp_path, "plane", "a", 2)
    (tmp_path / "03001627" / "empty").mkdir(parents=True)
    for category, synset in (("car", "02958343"), ("chair", "03001627")):
        arguments = ["--source", "shapenet", "--category", category, "--root", tmp_path]
        assert spnr_data("generate", tmp_path / "set", *arguments) == 2
        message = capsys.readouterr().err
        assert f"expected {synset}/*/models/model_normalized.obj or {synset}/*/model.obj" in message
        assert "it holds 02691156, 03001627" in message
        assert message.count("\n") == 1


@pytest.mark.parametrize(("version", "category"), [(2, "car"), (1, "chair")])
def test_the_preset_makes_the_data_set(tmp_path, capsys, version, category):
    root, out = download(tmp_path / "ShapeNetCore", category, version), tmp_path / "set"
    preset = ["--preset", f"shapenet_{category}", "--root", root, "--test-objects", 2]
    assert spnr_data("generate", out, *preset, *TINY, "--variant", "scalar_rgb") == 0
    assert ("128 test" if category == "car" else "105 test") in capsys.readouterr().err
    assert [len(layout.read_split(out, split)) for split in layout.SPLITS] == [4, 0, 2]
    reasons = {row["id"]: row["reason"] for row in map(json.loads, (out / "rejected.jsonl").read_text().splitlines())}
    assert reasons.keys() == {"e" * 32, "f" * 32, "meshless"}
    assert "missing: " in reasons["e" * 32]
    assert "transparent" in reasons["f" * 32]
    assert "neither models/model_normalized.obj" in reasons["meshless"]
    details = json.loads((out / "objects" / f"{3:032x}" / "object.json").read_text())
    assert details["category"] == category
    assert details["source"]["file"] == f"{sources.SYNSETS[category]}/{3:032x}/{PLACES[version][0]}.obj"
    assert spnr_data("check", out) == 0


def test_a_split_file_of_shapenet_makes_those_objects_only_and_an_option_overrides_the_preset(tmp_path):
    root = download(tmp_path / "ShapeNetCore", "car", 2)
    rows = [f"{number:06d},02958343,02958343,{number:032x},{split}" for number, split in enumerate(("train", "test"))]
    (tmp_path / "all.csv").write_text("\n".join(["id,synsetId,subSynsetId,modelId,split", *rows]))
    options = ["--root", root, "--split-file", tmp_path / "all.csv", "--colour-variants", 1]
    arguments = [str(word) for word in ("generate", "out", "--preset", "shapenet_car", *options)]
    made = tasks.plan_data_set(parse(arguments))
    split = made.split([task.object_id for task in made.tasks])
    assert split == {"train": [f"{0:032x}"], "val": [], "test": [f"{1:032x}"]}
    assert [variant.object_id for variant in made.variants(split["train"])] == [f"{0:032x}--1"]
