import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.gltf_files import GltfBuilder
from support.point_clouds import SRGB, read, write

from data_gen.store.layout import POINT_TYPE, encode_points
from spnr_jax.formats import clouds
from spnr_jax.formats.clouds import place_cloud, read_cloud
from spnr_jax.formats.orientation import ROTATIONS
from spnr_jax.kernels.cloud_arrays import pad
from spnr_jax.surfels.sides import spiral

SQUARE_OBJ = "v 0 0 2\nv 1 0 2\nv 1 1 2\nv 0 1 2\nf 1 2 3 4\n"
SQUARE_OFF = "OFF\n4 1 0\n0 0 2\n1 0 2\n1 1 2\n0 1 2\n4 0 1 2 3\n"
SQUARE_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n"
    "property list uchar int vertex_indices\nend_header\n"
    "0 0 2 188 0 255\n1 0 2 188 0 255\n1 1 2 188 0 255\n0 1 2 188 0 255\n3 0 1 2\n3 0 2 3\n"
)


def test_the_points_of_a_data_set_come_back_as_they_are_and_nothing_is_assumed(tmp_path):
    rng = np.random.default_rng(0)
    points = np.zeros(700, POINT_TYPE)
    for name in POINT_TYPE.names:
        points[name] = rng.uniform(size=700)
    for names in (("x", "y", "z"), ("nx", "ny", "nz")):
        for name, column in zip(names, spiral(700).T, strict=True):
            points[name] = column
    (tmp_path / "points.ply").write_bytes(encode_points(points))
    cloud, lines = read(tmp_path / "points.ply")
    np.testing.assert_array_equal(cloud.positions, np.stack([points[name] for name in "xyz"], axis=-1))
    np.testing.assert_array_equal(cloud.base_color[:, 1], points["base_color_g"])
    np.testing.assert_array_equal(cloud.roughness, points["roughness"])
    np.testing.assert_array_equal(cloud.metallic, points["metallic"])
    assert cloud.mask.all()
    assert {a.dtype for a in (cloud.positions, cloud.base_color, cloud.roughness)} == {np.dtype("float32")}
    assert lines == []


def test_what_a_file_does_not_say_is_grey_half_rough_no_metal_and_reported(tmp_path):
    cloud, lines = read(write(tmp_path, "a.xyz", "0 0 0\n1 2 3\n0 1 0\n"))
    assert (cloud.base_color == 0.5).all()
    assert (cloud.roughness == 0.5).all()
    assert (cloud.metallic == 0).all()
    assert [line.split()[:2] for line in lines] == [["no", name] for name in ("base_color", "roughness", "metallic")]
    cloud, lines = read(write(tmp_path, "b.csv", "x,y,z,metalness\n0,0,0,0.25\n1,0,0,0.25\n0,1,0,0.25\n"))
    assert (cloud.metallic == 0.25).all()
    assert not any("metallic" in line for line in lines)


def test_points_are_spread_evenly_over_a_mesh_unless_there_are_very_many(tmp_path, monkeypatch):
    def nearest(count):
        positions = read_cloud(write(tmp_path, "a.obj", SQUARE_OBJ), num_points=count, seed=1).positions
        return cKDTree(positions).query(positions, k=2)[0][:, 1].min() * np.sqrt(count)

    monkeypatch.setattr(clouds, "MOST_EVEN", 300)
    assert nearest(300) > 0.5  # of the distance on a square lattice
    assert nearest(301) < 0.2


@pytest.mark.parametrize("name", ["a.obj", "a.off", "a.ply", "a.stl", "a.glb", "a.gltf"])
def test_the_surface_of_a_mesh_is_sampled_with_its_material(tmp_path, name):
    path = tmp_path / name
    color, (roughness, metallic) = (0.5, 0.5, 0.5), (0.5, 0.0)
    if name.endswith(("glb", "gltf")):
        builder, color, (roughness, metallic) = GltfBuilder(), (0.5, 0.25, 1.0), (0.75, 0.125)
        factors = {"baseColorFactor": [*color, 1], "roughnessFactor": roughness, "metallicFactor": metallic}
        square = builder.primitive(material=builder.material(pbrMetallicRoughness=factors))
        builder.mesh(square, translation=[0, 0, 2])
        builder.write(path)
    elif name == "a.ply":
        write(tmp_path, name, SQUARE_PLY)
        color = SRGB[[188, 0, 255]]
    elif name == "a.stl":
        corner = "vertex 0 0 2\n", "vertex 1 0 2\n", "vertex 1 1 2\n", "vertex 0 1 2\n"
        facets = "".join(
            f"facet normal 0 0 1\nouter loop\n{a}{b}{c}endloop\nendfacet\n"
            for a, b, c in (corner[:3], (corner[0], *corner[2:]))
        )
        write(tmp_path, name, f"solid a\n{facets}endsolid a\n")
    else:
        write(tmp_path, name, SQUARE_OBJ if name == "a.obj" else SQUARE_OFF)
    cloud = read_cloud(path, num_points=400, seed=3)
    np.testing.assert_allclose(cloud.positions[:, 2], 2, atol=1e-6)
    np.testing.assert_allclose(cloud.positions[:, :2].mean(axis=0), 0.5, atol=0.06)
    np.testing.assert_allclose(np.ptp(cloud.positions[:, :2], axis=0), 1, atol=0.03)
    np.testing.assert_allclose(cloud.base_color, np.broadcast_to(color, (400, 3)), atol=2e-3)
    np.testing.assert_allclose(cloud.roughness, roughness, atol=1e-6)
    np.testing.assert_allclose(cloud.metallic, metallic, atol=1e-6)
    np.testing.assert_allclose(cloud.normals, np.broadcast_to([0, 0, 1], (400, 3)), atol=1e-6)
    np.testing.assert_array_equal(read_cloud(path, num_points=400, seed=3).positions, cloud.positions)
    assert len(read_cloud(path).mask) == 4096


@pytest.mark.parametrize("up", ROTATIONS)
def test_up_is_a_rotation_that_takes_the_named_axis_to_y(tmp_path, up):
    np.save(tmp_path / "axes.npy", np.eye(3))
    images = read_cloud(tmp_path / "axes.npy", up=up).positions
    sign = -1 if up.startswith("-") else 1
    np.testing.assert_array_equal(sign * images["xyz".index(up[-1])], [0, 1, 0])
    np.testing.assert_allclose(np.linalg.det(images), 1)
    np.testing.assert_array_equal(images @ images.T, np.eye(3))


@pytest.mark.parametrize("names", ["nx ny nz", "normal_x normal_y normal_z", "scalar_nx scalar_ny scalar_nz"])
def test_normals_have_unit_length_and_turn_with_the_cloud_and_a_row_without_one_gets_zero(tmp_path, names):
    rows = ["0 0 1 0 0 2", "0 1 0 0 -3e-9 0", "1 0 0 0 0 0", "2 0 0 nan 0 1", "3 0 0 inf 0 0", "4 0 0 3 4 0"]
    path = write(tmp_path, "a.csv", "\n".join([f"x y z {names}", *rows]))
    normals = [[0, 0, 1], [0, -1, 0], [0] * 3, [0] * 3, [0] * 3, [0.6, 0.8, 0]]
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.normals, normals, atol=1e-7)
    assert cloud.normals.dtype == np.float32
    np.testing.assert_allclose(read_cloud(path, up="z").normals, normals @ np.array(ROTATIONS["z"]).T, atol=1e-7)
    np.testing.assert_allclose(pad(cloud, 8).normals, [*normals, [0] * 3, [0] * 3], atol=1e-7)


def test_a_cloud_without_a_usable_normal_has_none(tmp_path):
    zeros = write(tmp_path, "zeros.csv", "x y z nx ny nz\n0 0 1 0 0 0\n0 1 0 nan 0 0\n1 0 0 0 0 0")
    part = write(tmp_path, "part.csv", "x y z nx ny\n0 0 1 0 1\n0 1 0 0 1\n1 0 0 0 1")
    packed = np.zeros(3, [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("nx", "ny", "nz")])
    packed["nx"] = 255
    packed["x"], packed["y"] = [0, 1, 0], [0, 0, 1]
    np.save(tmp_path / "packed.npy", packed)
    for path in (zeros, part, tmp_path / "packed.npy"):
        assert read_cloud(path).normals is None
    assert pad(read_cloud(zeros), 4).normals is None


def test_map_coordinates_keep_their_precision_and_the_way_back_is_kept(tmp_path):
    points = np.random.default_rng(0).uniform(0, 1, (50, 3)) + [500_000, 4_000_000, 100]
    np.save(tmp_path / "a.npy", points)
    placed = place_cloud(tmp_path / "a.npy", up="z")
    back = placed.cloud.positions @ placed.rotation + placed.origin
    np.testing.assert_allclose(back, points, rtol=0, atol=1e-6)
    np.testing.assert_allclose(placed.cloud.positions[:, 1], points[:, 2] - placed.origin[2], atol=1e-6)


class TestCleaning:
    def scan(self, folder):
        """A ball of 600 points and 6 far from it."""
        far = 4 * np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, 1], [1, -1, -1]])
        np.save(folder / "a.npy", np.concatenate([spiral(600), far]))
        return folder / "a.npy"

    def test_comes_before_thinning_and_says_what_it_did(self, tmp_path):
        cloud, lines = read(self.scan(tmp_path), num_points=50, clean="auto")
        assert np.abs(cloud.positions).max() <= 1
        assert lines[-2:] == ["removed 6 outliers of 606 points", "50 of 600 points kept, evenly spread"]
