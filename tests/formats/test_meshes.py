"""Mesh folders and files: ids, the formats without materials, and real files where they are at hand."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.gltf_files import CORNERS, SQUARE, GltfBuilder

from spnr_jax.formats.assets import RejectedAsset
from spnr_jax.formats.meshes import find_meshes, load_mesh
from spnr_jax.formats.surface_points import normalise, sample_surface

DATA = Path(__file__).parents[3] / "shared" / "data"
FACES = SQUARE.reshape(2, 3)


def write(path, text=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def ids(folder, *names):
    for name in names:
        write(folder / name)
    return {identifier: str(path.relative_to(folder)) for identifier, path in find_meshes(folder)}


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


@pytest.mark.parametrize("suffix", ["ply", "stl", "stl_ascii", "off", "obj"])
def test_geometry_without_materials_is_grey_half_rough_and_no_metal(tmp_path, suffix):
    path = tmp_path / f"a.{suffix.removesuffix('_ascii')}"
    trimesh.Trimesh(CORNERS, FACES, process=False).export(path, file_type=suffix)
    (part,) = load_mesh(path).parts
    found = {tuple(map(tuple, triangle)) for triangle in part.positions[part.faces]}
    assert found == {tuple(map(tuple, triangle)) for triangle in CORNERS[FACES].astype(float)}
    np.testing.assert_array_equal(part.material.base_color, [0.5, 0.5, 0.5])
    assert (part.material.roughness, part.material.metallic) == (0.5, 0)


def test_unused_vertices_go_and_normals_become_unit(tmp_path):
    builder = GltfBuilder()
    positions = np.concatenate([np.full((3, 3), 50, np.float32), CORNERS])
    normals = np.tile(np.float32([0, 0, 3]), (7, 1))
    normals[4] = 0
    builder.mesh(builder.primitive(positions, SQUARE + np.uint16(3), NORMAL=normals))
    asset = load_mesh(builder.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(asset.parts[0].positions, CORNERS)
    np.testing.assert_array_equal(asset.parts[0].normals, [[0, 0, 1]] * 4)
    assert asset.ignored == ("some normals without a direction (the faces' are used)",)


REAL = pytest.mark.skipif(not DATA.is_dir(), reason="the folder of real mesh files is not beside this checkout")
REFUSED = {  # as references
    "blend_muscle_car": "is transparent: material 'Lamp_glass.003' has alphaMode BLEND",
    "lines_and_triangles_window": "is transparent: material 'Glass_Crystal' has alphaMode BLEND",
    "missing_texture_wicker_chair": "names a file that is missing: 'textures/Wicker_chair_baseColor.png'",
}


@REAL
def test_each_hard_file_is_read_or_refused_with_the_right_reason():
    found = dict(find_meshes(DATA / "hard"))
    assert len(found) == 10
    for name, path in found.items():
        if name in REFUSED:
            with pytest.raises(RejectedAsset, match=REFUSED[name]):
                load_mesh(path)
            continue
        points = sample_surface(normalise(load_mesh(path))[0], 256, 0)
        assert all(np.isfinite(values).all() for values in vars(points).values())
        for values in (points.base_color, points.roughness, points.metallic):
            assert 0 <= values.min() <= values.max() <= 1
        np.testing.assert_allclose(np.linalg.norm(points.normals, axis=-1), 1, atol=1e-5)
        assert np.linalg.norm(points.positions, axis=-1).max() <= 1 + 1e-5


@REAL
@pytest.mark.parametrize("name", ["sk_777_219", "kenney_racer", "sk_seat_ba", "negative_scale_test"])
def test_geometry_agrees_with_trimesh(name):
    path = next(DATA.glob(f"*/**/{name}.glb"))
    theirs, asset = trimesh.load_scene(path).to_geometry(), load_mesh(path)
    ours = np.concatenate([part.positions[part.faces] for part in asset.parts])
    np.testing.assert_allclose([ours.min(axis=(0, 1)), ours.max(axis=(0, 1))], theirs.bounds, rtol=1e-5, atol=1e-5)
    area = np.linalg.norm(np.cross(ours[:, 1] - ours[:, 0], ours[:, 2] - ours[:, 0]), axis=-1).sum() / 2
    assert area == pytest.approx(theirs.area, rel=1e-5)
