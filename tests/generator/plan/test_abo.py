"""Amazon Berkeley Objects: a miniature of the download, found, split, augmented and rendered by the real code."""

import gzip
import json

import numpy as np
import pytest
from support.command_line import spnr_data
from support.gltf_files import CORNERS, SQUARE, GltfBuilder

from data_gen.plan import sources
from data_gen.store import layout

HEADER = "3dmodel_id,path,meshes,materials,textures,images,image_height_max,image_height_min,image_width_max,"
HEADER += "image_width_min,vertices,faces,extent_x,extent_y,extent_z"
PRODUCTS = [f"B07{number:06d}{letter}" for number, letter in enumerate("LL91ABC0")]
TINY = ["--resolution", 16, "--views", 2, "--points", 64, "--spp", 4, "--visibility-grid", 1, "--workers", 2]
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


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


@pytest.fixture(scope="module")
def download(tmp_path_factory):
    """A root with six good products, a transparent one, a row without a file, and a file without a row."""
    root = tmp_path_factory.mktemp("abo")
    metadata = root / "3dmodels" / "metadata"
    metadata.mkdir(parents=True)
    (metadata / "3dmodels.csv.gz").write_bytes(gzip.compress(rows(PRODUCTS).encode()))
    for number, name in enumerate([*PRODUCTS[:-1], "B00EXTRA01"]):
        folder = root / "3dmodels" / "original" / name[-1]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.glb").write_bytes(product(number, "BLEND" if number == 6 else None))
    return root


def test_the_metadata_say_what_a_product_is(download):
    listed = sources.find_products(download)
    assert [item.object_id for item in listed] == sorted([*PRODUCTS, "B00EXTRA01"])
    faults = {item.object_id: item.fault for item in listed if item.fault}
    assert faults == {
        "B00EXTRA01": "has no row in 3dmodels.csv.gz",
        PRODUCTS[-1]: f"3dmodels.csv.gz lists it, but there is no file 3dmodels/original/0/{PRODUCTS[-1]}.glb",
    }
    inner = sources.find_products(download / "3dmodels")
    assert [item.path for item in inner] == [item.path for item in listed]


def test_a_table_that_is_not_compressed_reads_the_same(tmp_path):
    (tmp_path / "metadata").mkdir()
    (tmp_path / "original" / "1").mkdir(parents=True)
    (tmp_path / "metadata" / "3dmodels.csv").write_text(rows(["B1"]))
    (tmp_path / "original" / "1" / "B1.glb").write_bytes(b"")
    (only,) = sources.find_products(tmp_path)
    assert (only.object_id, only.fault) == ("B1", "")


def test_another_folder_is_refused_with_what_was_expected_and_found(tmp_path, capsys):
    for name in ("listings", "spins"):
        (tmp_path / name).mkdir()
    assert spnr_data("generate", tmp_path / "set", "--source", "abo", "--root", tmp_path) == 2
    message = capsys.readouterr().err
    assert "3dmodels/original/*/*.glb and 3dmodels/metadata/3dmodels.csv.gz" in message
    assert "it holds listings, spins" in message
    assert message.count("\n") == 1
    assert spnr_data("generate", tmp_path / "set", "--source", "abo", "--root", tmp_path / "absent") == 2
    assert "there is no such folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"not gzip", "cannot be read"),
        (gzip.compress(rows(PRODUCTS).encode())[:60], "cannot be read"),
        (gzip.compress(b"3dmodel_id,path\na,A/a.glb\n", mtime=0)[:12] + b"\xff" * 20, "cannot be read"),
        (gzip.compress(b"id,file\nA,B\n"), "line 2: expected columns 3dmodel_id and path"),
        (gzip.compress(rows(["B1", "B1"]).encode()), "line 3: product B1 is listed twice"),
    ],
    ids=["not compressed", "cut off", "damaged", "other columns", "listed twice"],
)
def test_a_damaged_table_is_one_line(tmp_path, content, expected):
    (tmp_path / "metadata").mkdir()
    (tmp_path / "original").mkdir()
    (tmp_path / "metadata" / "3dmodels.csv.gz").write_bytes(content)
    with pytest.raises(ValueError, match=expected) as caught:
        sources.find_products(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.ci
def test_the_preset_makes_the_data_set_with_variants_of_training_products_only(download, tmp_path, capsys):
    out = tmp_path / "set"
    command = ["generate", out, "--preset", "abo", "--root", download, *TINY, "--variant", "scalar_rgb"]
    command += ["--test-objects", 2, "--train-objects", 9, "--colour-variants", 2]
    assert spnr_data(*command) == 0
    assert "the paper has 16161 train, 200 test" in capsys.readouterr().err
    splits = {split: layout.read_split(out, split) for split in layout.SPLITS}
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
    before = {path: path.stat().st_mtime_ns for path in (out / "objects").rglob("*")}
    assert spnr_data(*command) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "objects").rglob("*")} == before
    settings = json.loads((out / "dataset.json").read_text())["settings"]
    assert (settings["preset"], settings["source"], settings["colour_variants"]) == ("abo", "abo", 2)
    name = next(name for name in splits["train"] if details[name]["variant"])
    check_variant(out, details[name])


def check_variant(out, details):
    """The variant's colours are its product's, rotated; its views and points are its own."""
    assert details["id"] == f"{details['product']}--{details['variant']}"
    folders = [out / "objects" / details[key] for key in ("product", "id")]
    original, variant = (layout.read_object(folder) for folder in folders)
    matrix = np.array(details["colour_rotation"]["matrix"])
    assert original.transforms != variant.transforms
    assert details["seeds"] != original.details["seeds"]
    flat = [material["base_color"] for material in details["materials"] if isinstance(material["base_color"], list)]
    was = [m["base_color"] for m in original.details["materials"] if isinstance(m["base_color"], list)]
    np.testing.assert_allclose(flat, np.array(was) @ matrix.T, atol=1e-6)
    means = [layout.point_columns(r.points, *layout.POINT_FIELDS[6:9]).mean(axis=0) for r in (original, variant)]
    np.testing.assert_allclose(means[1], matrix @ means[0], atol=0.03)
    assert np.abs(means[1] - means[0]).max() > 0.03


@pytest.mark.parametrize("path", ["../../secret.glb", "/etc/a.glb", "A/../../a.glb", "A\\a.glb"])
def test_a_table_whose_paths_lead_elsewhere_is_refused(path, tmp_path):
    (tmp_path / "3dmodels.csv").write_text(f"3dmodel_id,path\na,{path}\n")
    with pytest.raises(ValueError, match="no file below"):
        sources.read_table(tmp_path / "3dmodels.csv")
