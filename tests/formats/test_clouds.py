import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.gltf_files import GltfBuilder
from support.point_clouds import ply_bytes, sphere_points

from data_gen.store.layout import POINT_TYPE, encode_points
from spnr_jax.formats import clouds
from spnr_jax.formats.clouds import place_cloud, read_cloud
from spnr_jax.formats.up_axis import ROTATIONS
from spnr_jax.kernels.cloud_arrays import bucket, normalization, pad
from spnr_jax.surfels.visibility import spiral

ROOT = Path(__file__).parents[2]
XYZRGB = [("x", "float"), ("y", "float"), ("z", "float"), ("red", "uchar"), ("green", "uchar"), ("blue", "uchar")]
SRGB = np.where(np.arange(256) <= 10, np.arange(256) / 255 / 12.92, ((np.arange(256) / 255 + 0.055) / 1.055) ** 2.4)
SQUARE_OBJ = "v 0 0 2\nv 1 0 2\nv 1 1 2\nv 0 1 2\nf 1 2 3 4\n"
SQUARE_OFF = "OFF\n4 1 0\n0 0 2\n1 0 2\n1 1 2\n0 1 2\n4 0 1 2 3\n"
SQUARE_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n"
    "property list uchar int vertex_indices\nend_header\n"
    "0 0 2 188 0 255\n1 0 2 188 0 255\n1 1 2 188 0 255\n0 1 2 188 0 255\n3 0 1 2\n3 0 2 3\n"
)


def write(folder, name: str, content: bytes | str):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def read(path, **options):
    """The cloud and the lines that it reported."""
    lines: list[str] = []
    return read_cloud(path, report=lines.append, **options), lines


def test_the_points_of_a_data_set_come_back_as_they_are_and_nothing_is_assumed(tmp_path):
    rng = np.random.default_rng(0)
    points = np.zeros(700, POINT_TYPE)
    for name in POINT_TYPE.names:
        points[name] = rng.uniform(size=700)
    (tmp_path / "points.ply").write_bytes(encode_points(points))
    cloud, lines = read(tmp_path / "points.ply")
    np.testing.assert_array_equal(cloud.positions, np.stack([points[name] for name in "xyz"], axis=-1))
    np.testing.assert_array_equal(cloud.base_color[:, 1], points["base_color_g"])
    np.testing.assert_array_equal(cloud.roughness, points["roughness"])
    np.testing.assert_array_equal(cloud.metallic, points["metallic"])
    assert cloud.mask.all()
    assert {a.dtype for a in (cloud.positions, cloud.base_color, cloud.roughness)} == {np.dtype("float32")}
    assert lines == []


def test_8_bit_unit_and_255_colours_are_the_same_linear_colour_and_the_report_says_how_they_were_read(tmp_path):
    levels = np.array([[0, 5, 188], [255, 64, 11]])
    rows = [(0.0, 0.0, float(i), *map(int, level)) for i, level in enumerate(levels)]
    text = "\n".join(" ".join(map(str, (*row[:3], *(v / 255 for v in row[3:])))) for row in rows)
    files = {
        write(
            tmp_path, "a.ply", ply_bytes("binary_big_endian", rows=rows, properties=XYZRGB)
        ): "red green blue .* 0..255",
        write(tmp_path, "b.xyz", "\n".join(" ".join(map(str, row)) for row in rows)): "red green blue .* 0..255",
        write(tmp_path, "c.csv", "x y z diffuse_red diffuse_green diffuse_blue\n" + text): "red green blue .* 0..1$",
        tmp_path / "d.npz": "red green blue .* 0..65535",
    }
    np.savez(tmp_path / "d.npz", points=np.array(rows)[:, :3], colors=(levels * 257).astype(np.uint16))
    for path, how in files.items():
        cloud, lines = read(path)
        np.testing.assert_allclose(cloud.base_color, SRGB[levels], rtol=1e-5)
        assert re.search(how, "\n".join(lines), re.MULTILINE), lines


def test_linear_base_colours_win_over_srgb_ones_and_are_not_decoded(tmp_path):
    np.savez(tmp_path / "a.npz", xyz=np.zeros((2, 3)), base_color=np.full((2, 3), 0.2), rgb=np.full((2, 3), 0.9))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.npz").base_color, 0.2)


def test_what_a_file_does_not_say_is_grey_half_rough_no_metal_and_reported(tmp_path):
    cloud, lines = read(write(tmp_path, "a.xyz", "0 0 0\n1 2 3\n"))
    assert (cloud.base_color == 0.5).all()
    assert (cloud.roughness == 0.5).all()
    assert (cloud.metallic == 0).all()
    assert [line.split()[:2] for line in lines] == [["no", name] for name in ("base_color", "roughness", "metallic")]
    cloud, lines = read(write(tmp_path, "b.csv", "x,y,z,metalness\n0,0,0,0.25\n"))
    assert cloud.metallic == [0.25]
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
    zeros = write(tmp_path, "zeros.csv", "x y z nx ny nz\n0 0 1 0 0 0\n0 1 0 nan 0 0")
    part = write(tmp_path, "part.csv", "x y z nx ny\n0 0 1 0 1\n0 1 0 0 1")
    packed = np.zeros(2, [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("nx", "ny", "nz")])
    packed["nx"] = 255
    np.save(tmp_path / "packed.npy", packed)
    for path in (zeros, part, tmp_path / "packed.npy"):
        assert read_cloud(path).normals is None
    assert pad(read_cloud(zeros), 4).normals is None


def test_a_point_that_is_kept_keeps_its_normal(tmp_path, monkeypatch):
    positions = sphere_points(2, 900)
    np.savez(tmp_path / "a.npz", xyz=positions, normals=2 * positions)
    monkeypatch.setattr(clouds, "CAPACITY", 400)
    cloud = read_cloud(tmp_path / "a.npz", num_points=20)
    assert len(cloud.mask) == 20
    np.testing.assert_allclose(cloud.normals, cloud.positions, atol=1e-6)


def test_thinning_keeps_points_of_the_file_with_their_materials_and_depends_on_the_seed_alone(tmp_path):
    positions = sphere_points(1, 900)
    np.savez(tmp_path / "a.npz", xyz=positions, roughness=np.arange(900) / 900)
    cloud, lines = read(tmp_path / "a.npz", num_points=100, seed=5)
    source = np.round(cloud.roughness * 900).astype(int)
    assert len(set(source)) == 100
    np.testing.assert_array_equal(cloud.positions, positions[source].astype(np.float32))
    assert lines[-1] == "100 of 900 points kept, evenly spread"
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npz", num_points=100, seed=5).roughness, cloud.roughness)
    assert (read_cloud(tmp_path / "a.npz", num_points=100, seed=6).roughness != cloud.roughness).any()
    np.testing.assert_array_equal(
        read_cloud(tmp_path / "a.npz", num_points=2000).positions, positions.astype(np.float32)
    )


def test_padding_adds_masked_zeros_and_changes_no_real_point(tmp_path):
    np.save(tmp_path / "a.npy", sphere_points(4, 5))
    cloud = read_cloud(tmp_path / "a.npy")
    padded = pad(cloud, 8)
    np.testing.assert_array_equal(padded.mask, np.arange(8) < 5)
    for name in ("positions", "base_color", "roughness", "metallic"):
        np.testing.assert_array_equal(getattr(padded, name)[:5], getattr(cloud, name))
        np.testing.assert_array_equal(getattr(padded, name)[5:], 0)
        assert getattr(padded, name).dtype == np.float32
    np.testing.assert_array_equal(pad(cloud, 5).positions, cloud.positions)
    with pytest.raises(ValueError, match="5 points does not fit into 4"):
        pad(cloud, 4)


def test_a_bucket_is_the_smallest_doubling_of_512_that_holds_the_points():
    sizes = [1, 511, 512, 513, 1024, 1025, 4096, 5000]
    assert [bucket(size) for size in sizes] == [512, 512, 512, 1024, 1024, 2048, 4096, 8192]
    with pytest.raises(ValueError, match="at least 1 point, got 0"):
        bucket(0)


def test_normalised_points_have_their_box_around_zero_with_half_diagonal_one():
    positions = (sphere_points(5, 50) * [3, 1, 0.2] + [5, -7, 100]).astype(np.float32)
    centre, scale = normalization(positions)
    normalised = (positions - centre) * scale
    np.testing.assert_allclose(normalised.min(axis=0), -normalised.max(axis=0), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(normalised.max(axis=0)), 1, rtol=1e-5)


def test_a_point_alone_is_moved_to_zero_and_not_scaled():
    centre, scale = normalization(np.array([[3.0, 4, 5]], np.float32))
    np.testing.assert_array_equal(centre, [3, 4, 5])
    assert scale == 1


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.ply", None, "no such file"),
        ("a.xyz", "", "the file is empty"),
        (
            "a.jpeg",
            "1 2 3",
            r"unknown kind of file '.jpeg'; expected one of .ply .pcd .xyz .txt .csv .npz .npy .las .laz .glb",
        ),
        ("a.xyz", "# nothing yet\n", "holds 0 points"),
        ("a.ply", ply_bytes("binary_little_endian", rows=[]), "holds 0 points"),
        ("a.xyz", "nan 0 0\n1 nan 0\n", "no point that can be used: NaN, infinity .* in all of its 2 rows"),
        ("a.xyz", "0 0 1e39\n", "too large a number"),
        ("a.csv", "px,py,pz\n0,0,0\n", r"needs the properties x y z \(and may have .*\); found px py pz"),
        ("a.xyz", "0 0 0 0.5 0.5 -0.2\n", "has red green blue from -0.2 to 0.5; expected 0 to 1"),
        ("a.xyz", "0 0 0 0.5 1.3 0.2\n", "colours up to 1.3: neither 0 to 1 nor 0 to 255"),
        ("a.xyz", "0 0 0 3 4 256\n", "from 0.01.* to 1.00392"),
        ("a.csv", "x y z base_color_r base_color_g base_color_b\n0 0 0 0 0 9\n", "from 0 to 9"),
        ("a.csv", "x y z roughness\n0 0 0 nan\n", "no point that can be used"),
        (
            "a.ply",
            ply_bytes("binary_little_endian", rows=[(0.0, 0.0, 5e6), (0.0, 0.0, 5e6 + 1)], properties=XYZRGB[:3]),
            "0.5 apart at best .* extent of 1; move them to the origin",
        ),
        ("a.ply", ply_bytes("binary_little_endian")[:-20], "announces 3 points, the data ends after 2"),
        ("a.obj", "v 0 0 0\n", "has no faces"),
        ("a.glb", b"glTF\2\0\0\0\xff\xff\0\0", "broken or truncated|cut off|truncated"),
    ],
)
def test_every_bad_file_is_one_line_that_names_it_and_the_reason(tmp_path, name, content, reason):
    path = tmp_path / name
    if content is not None:
        write(tmp_path, name, content)
    with pytest.raises(ValueError, match=reason) as caught:
        read_cloud(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_folder_is_no_cloud(tmp_path):
    with pytest.raises(ValueError, match=r"a folder; expected a file of one of .ply .pcd"):
        read(tmp_path)


def test_a_mesh_without_material_says_so(tmp_path):
    _, lines = read(write(tmp_path, "a.obj", SQUARE_OBJ), num_points=10)
    assert any(line.startswith("no material in the mesh: base_color 0.5, roughness 0.5, metallic 0") for line in lines)
    _, lines = read(write(tmp_path, "a.ply", SQUARE_PLY), num_points=10)
    assert not any("no material" in line for line in lines)


def test_map_coordinates_keep_their_precision_and_the_way_back_is_kept(tmp_path):
    points = np.random.default_rng(0).uniform(0, 1, (50, 3)) + [500_000, 4_000_000, 100]
    np.save(tmp_path / "a.npy", points)
    placed = place_cloud(tmp_path / "a.npy", up="z")
    back = placed.cloud.positions @ placed.rotation + placed.origin
    np.testing.assert_allclose(back, points, rtol=0, atol=1e-6)
    np.testing.assert_allclose(placed.cloud.positions[:, 1], points[:, 2] - placed.origin[2], atol=1e-6)


def test_up_is_found_where_it_is_left_to_the_reader_and_said(tmp_path):
    rng = np.random.default_rng(0)
    cone = rng.uniform(-1, 1, (900, 3)) * [1, 1, 0.01]
    cone[:300] *= np.linspace(1, 0, 300)[:, None]
    cone[:300, 2] += np.linspace(0, 2, 300)
    np.save(tmp_path / "a.npy", cone)
    lines: list[str] = []
    placed = place_cloud(tmp_path / "a.npy", report=lines.append)
    assert placed.up == "z"
    assert any(line.startswith("z taken as up") for line in lines)
    assert place_cloud(tmp_path / "a.npy", up="-x").up == "-x"


LITTLE_MEMORY = """
import resource, sys
from spnr_jax.formats.clouds import read_cloud
before = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (before + int(sys.argv[2]),) * 2)
cloud = read_cloud(sys.argv[1], num_points=256)
print(len(cloud.mask), *cloud.positions.min(axis=0), *cloud.positions.max(axis=0))
"""


def big_file(folder, suffix: str):
    """A file of a cube's surface, several times larger than the memory that its reader gets."""
    rng = np.random.default_rng(0)
    if suffix == ".xyz":
        points = rng.uniform(-1, 1, (20_000, 3))
        points[np.arange(20_000), np.arange(20_000) % 3] = np.where(np.arange(20_000) % 2, 1, -1)
        block = "".join(f"{x:.60f} {y:.60f} {z:.60f}\n" for x, y, z in points)
        with (folder / "big.xyz").open("w") as file:
            for _ in range(100):
                file.write(block)
        return folder / "big.xyz"
    path, count = folder / "big.ply", 4_000_000
    properties = [(f"p{i}", "double") for i in range(20)]
    header = ply_bytes("binary_little_endian", rows=[], properties=XYZRGB[:3] + properties, before=0)
    header = header[: header.index(b"element edge")] + b"end_header\n"
    points = np.zeros(count // 100, [(name, "<f4") for name in "xyz"] + [(name, "<f8") for name, _ in properties])
    for axis in "xyz":
        points[axis] = rng.uniform(-1, 1, len(points))
    for i, axis in enumerate("xyz"):
        points[axis][i::3] = rng.choice([-1, 1], len(points[i::3]))
    with path.open("wb") as file:
        file.write(header.replace(b"element vertex 0", b"element vertex %d" % count))
        for _ in range(100):
            file.write(points.tobytes())
    return path


@pytest.mark.slow
@pytest.mark.parametrize(("suffix", "memory"), [(".ply", 400e6), (".xyz", 220e6)])
def test_a_cloud_larger_than_the_memory_is_read(tmp_path, suffix, memory):
    path = big_file(tmp_path, suffix)
    assert path.stat().st_size > 1.7 * memory
    done = subprocess.run(
        [sys.executable, "-c", LITTLE_MEMORY, path, str(int(memory))], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr[-2000:]
    count, *bounds = done.stdout.split()
    assert int(count) == 256
    np.testing.assert_allclose(np.float64(bounds), [-1, -1, -1, 1, 1, 1], atol=0.01)


def test_a_cloud_beyond_the_capacity_is_thinned_while_reading_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "CAPACITY", 500)
    positions = sphere_points(1, 4000)
    np.savez(tmp_path / "a.npz", xyz=positions, roughness=np.arange(4000) / 4000)
    cloud, lines = read(tmp_path / "a.npz")
    assert 60 <= len(cloud.mask) <= 500
    assert lines[0] == f"{len(cloud.mask)} of 4000 points kept while reading, the first of each voxel"
    source = np.round(cloud.roughness * 4000).astype(int)
    np.testing.assert_array_equal(cloud.positions, positions[source].astype(np.float32))


def test_wrong_options_are_refused_before_the_file_is_touched():
    with pytest.raises(ValueError, match="up must be one of y, -y, z, -z, x, -x, auto, got 'w'"):
        read_cloud("absent.ply", up="w")
    with pytest.raises(ValueError, match="num_points must be at least 1, got 0"):
        read_cloud("absent.ply", num_points=0)


BROKEN_ROWS = np.array(
    [(0, 0, 0, 0.25), (np.nan, 1, 1, 0.5), (1, 2, 3, 1), (0, -np.inf, 0, 0), (4, 5, 6, np.nan), (1e39, 0, 0, 0)],
    [("x", "f8"), ("y", "f8"), ("z", "f8"), ("roughness", "f8")],
)


def broken_file(folder, name: str):
    """A file of BROKEN_ROWS, of which two can be used."""
    path, table = folder / name, np.stack([BROKEN_ROWS[field] for field in BROKEN_ROWS.dtype.names], axis=-1)
    text = "\n".join(" ".join(map(repr, map(float, row))) for row in table)
    if name.endswith(".npz"):
        np.savez(path, xyz=table[:, :3], roughness=table[:, 3])
    elif name.endswith(".npy"):
        np.save(path, BROKEN_ROWS)
    elif name.endswith(".ply"):
        properties = [(field, "double") for field in BROKEN_ROWS.dtype.names]
        path.write_bytes(ply_bytes("binary_little_endian", rows=BROKEN_ROWS.tolist(), properties=properties))
    elif name.endswith(".pcd"):
        # an organised cloud, as a depth camera writes it
        head = "VERSION 0.7\nFIELDS x y z roughness\nSIZE 8 8 8 8\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 3\nHEIGHT 2\n"
        path.write_bytes((head + "POINTS 6\nDATA binary\n").encode() + BROKEN_ROWS.tobytes())
    else:
        path.write_text(("x y z roughness\n" if name.endswith(".csv") else "# x y z roughness\n") + text)
    return path


@pytest.mark.parametrize("name", ["a.pcd", "a.ply", "a.npz", "a.npy", "a.xyz", "a.csv"])
def test_rows_without_finite_numbers_are_left_out_and_counted_in_one_line(tmp_path, name):
    cloud, lines = read(broken_file(tmp_path, name))
    np.testing.assert_array_equal(cloud.positions, [[0, 0, 0], [1, 2, 3]])
    np.testing.assert_array_equal(cloud.roughness, [0.25, 1])
    assert [line for line in lines if "left out" in line] == [
        "4 of 6 points left out: NaN, infinity or too large a number"
    ]


def test_rows_without_finite_numbers_are_left_out_while_a_big_file_is_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "CAPACITY", 16)
    monkeypatch.setattr("spnr_jax.formats.text.PIECE_LINES", 7)
    positions = np.concatenate([np.full((20, 3), np.nan), sphere_points(3, 300), np.full((9, 3), np.inf)])
    np.savetxt(tmp_path / "a.xyz", positions)
    cloud, lines = read(tmp_path / "a.xyz", num_points=1)
    assert np.isfinite(cloud.positions).all()
    assert lines[0] == "29 of 329 points left out: NaN, infinity or too large a number"
    assert re.fullmatch(r"\d+ of 300 points kept while reading.*", lines[1])


def test_a_data_set_with_a_broken_row_is_refused():
    with pytest.raises(ValueError, match="holds 4 points with NaN, infinity .* first point 1"):
        clouds.cloud_of_ply(
            ply_bytes(
                "binary_little_endian",
                rows=BROKEN_ROWS.tolist(),
                properties=[(field, "double") for field in BROKEN_ROWS.dtype.names],
            )
        )


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

    def test_is_off_unless_it_is_asked_for(self, tmp_path):
        for options in ({}, {"clean": "off"}):
            cloud, lines = read(self.scan(tmp_path), **options)
            assert len(cloud.positions) == 606
            assert not any("outliers" in line for line in lines)

    def test_cleans_what_is_kept_of_a_file_that_is_thinned_while_reading(self, tmp_path, monkeypatch):
        monkeypatch.setattr(clouds, "CAPACITY", 500)
        cloud, lines = read(self.scan(tmp_path), clean="auto")
        assert np.abs(cloud.positions).max() <= 1
        assert any(
            re.fullmatch(r"removed 6 outliers of \d\d\d points, told by a sample of the file", line) for line in lines
        )

    def test_leaves_meshes_alone(self, tmp_path):
        path = write(tmp_path, "a.obj", SQUARE_OBJ)
        plain, lines = read(path, num_points=200, clean="strong")
        np.testing.assert_array_equal(plain.positions, read_cloud(path, num_points=200).positions)
        assert not any("outliers" in line or "averaged" in line for line in lines)
