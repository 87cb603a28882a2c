"""Clouds out of files: what is assumed, cut out, thinned and turned, in the file's own frame."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.point_clouds import read, sphere_points, write, write_rows

from data_gen.store.layout import POINT_TYPE, encode_points
from spnr_jax.config import Cut
from spnr_jax.formats import clouds
from spnr_jax.formats.clouds import place_cloud, read_cloud
from spnr_jax.formats.orientation import ROTATIONS
from spnr_jax.kernels.cloud_arrays import pad
from spnr_jax.surfels.sides import spiral

FAR = np.array([5e6, 2e6, 0.0])  # where float32 knows half metres at best
LEVEL = 0.2140411  # linear value of sRGB 0.5


def test_the_points_of_a_data_set_come_back_as_they_are_and_nothing_is_assumed(tmp_path):
    points = np.zeros(700, POINT_TYPE)
    for name, column in zip(POINT_TYPE.names, np.random.default_rng(0).random((99, 700)), strict=False):
        points[name] = column
    for names in (("x", "y", "z"), ("nx", "ny", "nz")):
        for name, column in zip(names, spiral(700).T, strict=True):
            points[name] = column
    cloud, lines = read(write(tmp_path, "points.ply", encode_points(points)))
    np.testing.assert_array_equal(cloud.positions, np.stack([points[name] for name in "xyz"], axis=-1))
    np.testing.assert_array_equal(cloud.base_color[:, 1], points["base_color_g"])
    for name in ("roughness", "metallic"):
        np.testing.assert_array_equal(getattr(cloud, name), points[name])
    assert cloud.positions.dtype == cloud.base_color.dtype == cloud.roughness.dtype == np.float32
    assert lines == ["columns that are not used: face"]


PLACES = spiral(60)
ORDERED = np.column_stack([np.linspace(-1, 1, 60), PLACES[:, 1:]])  # x rises as a time would
GREEN, DELTA = (0.02122, 0.40198, 0.04519), "\N{GREEK CAPITAL LETTER DELTA}"


@pytest.mark.parametrize(
    ("names", "places", "rest", "color"),
    [
        (f"x,y,z,{DELTA}x,{DELTA}y,{DELTA}z", PLACES, "9,8,7", None),
        ("x,y,z,color,id", PLACES, "#28aa3c,0x00002a", GREEN),
        ("x,y,z,id", PLACES, "0x00002a", None),
        ("x,y,z,color,note", PLACES, "#28a1d2,n/a", (0.02122, 0.35640, 0.64448)),
        ("", ORDERED, "0,0,1,40,170,60", GREEN),
        ("", ORDERED, "40,170,60,0.25,0.75", GREEN),
        ("x,y,z,a,b", PLACES, "nan(ind),.0", None),
        ("", PLACES, "302400", None),
    ],
)
def test_what_only_resembles_something_else_is_not_taken_for_it(tmp_path, names, places, rest, color):
    rows = [",".join([*(f"{x:.6f}" for x in place), rest]) for place in places]
    rows = [row.replace("302400", str(302400 + i)) for i, row in enumerate(rows)]  # seconds of a GPS week
    path = tmp_path / "points.csv"
    path.write_text("\n".join([names, *rows] if names else rows))
    cloud, _ = read(path)
    np.testing.assert_allclose(cloud.positions, places, atol=1e-5)
    grey = cloud.base_color[:, :1]
    np.testing.assert_allclose(cloud.base_color, np.broadcast_to(grey if color is None else color, (60, 3)), atol=1e-3)


# Columns


def materials(folder, **columns):
    """Base colours, roughness and metallic of three points with the columns, and what was reported."""
    cloud, lines = read(write_rows(folder, [[0, 0, 0], [1, 0, 0], [0, 1, 0]], **columns))
    return cloud.base_color, cloud.roughness, cloud.metallic, [line for line in lines if "points alone" not in line]


NAMES = {  # of channels, and the linear value of 0.5 in them
    **dict.fromkeys(("red green blue", "r g b", "diffuse_red diffuse_green diffuse_blue", "rf gf bf"), LEVEL),
    **dict.fromkeys(("color_red color_green color_blue", "scalar_r scalar_g scalar_b", "rgb_1 rgb_2 rgb_3"), LEVEL),
    **dict.fromkeys(("colour_r colour_g colour_b", "vertex_color_r vertex_color_g vertex_color_b"), LEVEL),
    **dict.fromkeys(("base_color_r base_color_g base_color_b", "albedo_r albedo_g albedo_b", "Cd.r Cd.g Cd.b"), 0.5),
}


@pytest.mark.parametrize("names", NAMES)
def test_colours_have_many_names_and_are_srgb_unless_these_say_that_they_are_linear(tmp_path, names):
    base_color, *_, lines = materials(tmp_path, **dict.fromkeys(names.split(), [0.5, 1.0, 0.0]))
    np.testing.assert_allclose(base_color, np.outer([NAMES[names], 1, 0], [1, 1, 1]), rtol=1e-5)
    assert ("red green blue taken as sRGB in 0..1" in lines) == (NAMES[names] == LEVEL)


@pytest.mark.parametrize("kind", ["<u4", "<i4", "<f4", "<f8"])
def test_packed_colours_are_whole_numbers_of_any_type_or_have_their_bits(tmp_path, kind):
    packed = np.array([0x40AA3C, 0xFF0000, 0x0000FF])
    for values in (packed.astype(kind), packed.astype("<u4").view("<f4"), (packed | 0xFF << 24).astype("<u4")):
        base_color, *_ = materials(tmp_path, rgb=values)
        np.testing.assert_array_equal(base_color[1:], [[1, 0, 0], [0, 0, 1]])
        np.testing.assert_allclose(base_color[0], [0.0513, 0.4020, 0.0452], atol=1e-4)


@pytest.mark.parametrize(
    ("rough", "metal"),
    [("roughness", "scalar_metallic"), ("scalar_roughness", "metalness"), ("pbr_roughness", "metal")],
)
def test_roughness_and_metallic_have_many_names_and_percent_or_whole_bytes(tmp_path, rough, metal):
    for white in (100, 255):
        _, roughness, metallic, lines = materials(tmp_path, **{rough: [0, white, 0], metal: [0.25, 0.75, 0]})
        np.testing.assert_array_equal(roughness, [0, 1, 0])
        np.testing.assert_array_equal(metallic, [0.25, 0.75, 0])
        assert lines == [f"roughness taken to be in 0..{white}", "no base_color in the file: 0.5 taken for all points"]


def test_intensity_is_grey_where_there_is_no_colour_and_unused_where_there_is(tmp_path):
    base_color, *_, lines = materials(tmp_path, scalar_intensity=[100, 300, 300])
    np.testing.assert_allclose(base_color[:, 0], [0, 1, 1], atol=0.01)
    assert lines[0].startswith("no colour in the file: intensity 104..300 shown as grey")
    cloud, lines = read(write_rows(tmp_path, spiral(402), intensity=[np.nan, -9999, *np.linspace(100, 300, 400)]))
    np.testing.assert_allclose(cloud.base_color[[0, 1, 2, -1], 0], [0.214, 0, 0, 1], atol=0.01)
    assert "no colour in the file: intensity 101.504..297.995 shown as grey, 1 without one as 0.5" in lines
    base_color, *_ = materials(tmp_path, intensity=[100, 300, 200], red=[1.0] * 3, green=[0.0] * 3, blue=[0.0] * 3)
    np.testing.assert_array_equal(base_color, [[1, 0, 0]] * 3)
    none_seen = materials(tmp_path, intensity=[100, 300, 200], red=[0] * 3, green=[0] * 3, blue=[0] * 3)
    assert none_seen[-1][0].startswith("no colour in the file: intensity")
    *_, lines = materials(tmp_path, intensity=[5, 5, 5])
    assert [line.split()[:2] for line in lines] == [["no", name] for name in ("base_color", "roughness", "metallic")]


@pytest.mark.parametrize("names", ["nx ny nz", "norm_x norm_y norm_z", "scalar_nx scalar_ny scalar_nz"])
def test_normals_have_unit_length_and_turn_with_the_cloud_and_a_row_without_one_gets_zero(tmp_path, names):
    rows = ["0 0 1 0 0 2", "0 1 0 0 -3e-9 0", "1 0 0 0 0 0", "2 0 0 nan 0 1", "3 0 0 inf 0 0", "4 0 0 3 4 0"]
    path = write(tmp_path, "a.csv", "\n".join([f"x y z {names}", *rows]))
    normals = [[0, 0, 1], [0, -1, 0], [0] * 3, [0] * 3, [0] * 3, [0.6, 0.8, 0]]
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.normals, normals, atol=1e-7)
    np.testing.assert_allclose(read_cloud(path, up="z").normals, normals @ np.array(ROTATIONS["z"]).T, atol=1e-7)
    np.testing.assert_allclose(pad(cloud, 8).normals, [*normals, [0] * 3, [0] * 3], atol=1e-7)


def test_a_cloud_without_a_usable_normal_has_none(tmp_path):
    for rows in ("nz\n0 0 1 0 0 0\n0 1 0 nan 0 0\n1 0 0 0 0 0", "n\n0 0 1 0 1 1\n0 1 0 0 1 1\n1 0 0 0 1 1"):
        assert read_cloud(write(tmp_path, "a.csv", f"x y z nx ny {rows}")).normals is None
    materials(tmp_path, **dict.fromkeys(("nx", "ny", "nz"), np.array([255, 0, 0], np.uint8)))  # an encoding of its own
    assert read_cloud(tmp_path / "a.npy").normals is None


@pytest.mark.parametrize(("kind", "bits"), [("<f4", 0x7FA00000), ("<f8", 0x7FF4000000000000)])
@pytest.mark.parametrize("column", [0, 4, 7])
def test_a_signalling_nan_costs_its_row_or_its_normal_and_no_warning(tmp_path, kind, bits, column):
    table = np.random.default_rng(0).random((50, 9)).astype(kind)
    table.view(kind.replace("f", "u"))[3, column] = bits
    np.save(tmp_path / "cloud.npy", table)
    cloud = read_cloud(tmp_path / "cloud.npy")  # warnings are errors in the tests
    assert len(cloud.positions) in (49, 50)
    assert np.isfinite(cloud.positions).all()


@pytest.mark.parametrize("up", ROTATIONS)
def test_up_is_a_rotation_that_takes_the_named_axis_to_y(tmp_path, up):
    np.save(tmp_path / "axes.npy", np.eye(3))
    images = read_cloud(tmp_path / "axes.npy", up=up).positions
    sign = -1 if up.startswith("-") else 1
    np.testing.assert_array_equal(sign * images["xyz".index(up[-1])], [0, 1, 0])
    np.testing.assert_allclose(np.linalg.det(images), 1)
    np.testing.assert_array_equal(images @ images.T, np.eye(3))


# Many points


def test_points_are_spread_evenly_over_a_mesh_unless_there_are_very_many(tmp_path, monkeypatch):
    path = write(tmp_path, "a.obj", "v 0 0 2\nv 1 0 2\nv 1 1 2\nv 0 1 2\nf 1 2 3 4\n")

    def nearest(count):
        positions = read_cloud(path, num_points=count, seed=1).positions
        return cKDTree(positions).query(positions, k=2)[0][:, 1].min() * np.sqrt(count)

    monkeypatch.setattr(clouds, "MOST_EVEN", 300)
    assert nearest(300) > 0.5  # of the distance on a square lattice
    assert nearest(301) < 0.2


@pytest.mark.ci
def test_thinning_covers_each_side_of_a_thin_wall_whose_normals_are_given(tmp_path):
    front = np.arange(4000) % 2 == 0
    wall = np.random.default_rng(1).random((4000, 3)) * [1, 1, 0] + front[:, None] * [0, 0, 0.004]

    def widest_gap(**columns):
        kept = read(write_rows(tmp_path, wall, **columns), num_points=400, clean="off")[0].positions
        sides = [(kept[:, 2] > 0.002, front), (kept[:, 2] < 0.002, ~front)]
        return max(cKDTree(kept[of_kept]).query(wall[of_all])[0].max() for of_kept, of_all in sides)

    assert widest_gap(nx=0 * front, ny=0 * front, nz=2.0 * front - 1) < 0.7 * widest_gap()


def test_thinning_keeps_points_of_the_file_with_their_materials_and_depends_on_the_seed_alone(tmp_path):
    positions = sphere_points(1, 900)
    np.savez(tmp_path / "a.npz", xyz=positions, normals=positions, roughness=np.arange(900) / 900)
    cloud, lines = read(tmp_path / "a.npz", num_points=100, seed=5)
    source = np.round(cloud.roughness * 900).astype(int)
    assert len(set(source)) == 100
    np.testing.assert_array_equal(cloud.positions, positions[source].astype(np.float32))
    assert lines[-1] == "100 of 900 points kept, evenly spread"
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npz", num_points=100, seed=5).roughness, cloud.roughness)
    assert (read_cloud(tmp_path / "a.npz", num_points=100, seed=6).roughness != cloud.roughness).any()
    assert len(read_cloud(tmp_path / "a.npz", num_points=2000).mask) == 900


LITTLE_MEMORY = """
import resource, sys
import numpy as np
from spnr_jax.formats.clouds import read_cloud
from spnr_jax.surfels.normals import VOTERS, outward_normals
outward_normals(*np.random.default_rng(0).random((2, 2 * VOTERS, 3)), np.arange(256))  # threads and programs of XLA
before = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (before + int(sys.argv[2]),) * 2)
cloud = read_cloud(sys.argv[1], num_points=256)
print(len(cloud.mask), *cloud.positions.min(axis=0), *cloud.positions.max(axis=0))
"""


@pytest.mark.slow
def test_a_cloud_larger_than_the_memory_is_read(tmp_path):
    corners, path = np.random.default_rng(0).choice([-1, 1], (40_000, 3)), tmp_path / "big.ply"
    rows = np.zeros(40_000, [*((axis, "<f4") for axis in "xyz"), *((f"p{i}", "<f8") for i in range(20))])
    for axis, column in zip("xyz", corners.T, strict=True):
        rows[axis] = column * np.random.default_rng(1).uniform(0.99, 1, 40_000)
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 4000000\n"
    head += "".join(f"property {'float' if name in 'xyz' else 'double'} {name}\n" for name in rows.dtype.names)
    with path.open("wb") as file:
        file.write(f"{head}end_header\n".encode())
        for _ in range(100):
            file.write(rows.tobytes())
    done = subprocess.run([sys.executable, "-c", LITTLE_MEMORY, path, "400000000"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert path.stat().st_size > 1.7 * 400e6
    count, *bounds = done.stdout.split()
    assert int(count) == 256
    np.testing.assert_allclose(np.float64(bounds), [-1, -1, -1, 1, 1, 1], atol=0.01)


def test_of_a_cloud_beyond_the_capacity_a_sample_of_the_sound_rows_is_kept_while_reading(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "CAPACITY", 500)
    monkeypatch.setattr("spnr_jax.formats.point_tables.PIECE_LINES", 700)
    positions = sphere_points(1, 4000)
    rows = np.column_stack([positions, 2 * positions, np.arange(4000) / 4000])
    rows = np.concatenate([np.full((20, 7), np.nan), rows, np.full((9, 7), np.inf)])
    np.savetxt(tmp_path / "a.xyz", rows, header="x y z nx ny nz roughness")
    cloud, lines = read(tmp_path / "a.xyz", clean="auto")
    assert 250 <= len(cloud.mask) <= 500
    assert lines[0] == "29 of 4,029 points left out: NaN, infinity or too large a number"
    assert lines[1] == f"{len(cloud.mask)} of 4000 points kept while reading, drawn at random"
    assert not any("outliers" in line for line in lines)  # where there are none
    source = np.round(cloud.roughness * 4000).astype(int)
    np.testing.assert_array_equal(cloud.positions, positions[source].astype(np.float32))
    np.testing.assert_allclose(cloud.normals, cloud.positions, atol=1e-6)


# One object of a scene


def scene(folder, origin=(0.0, 0.0, 0.0)):
    """A file of a large and a small ball, and one point far from both."""
    points = [spiral(900), 0.3 * spiral(450) + [2, 0, 0], [[0, 4, 0]]]
    normals = np.concatenate([spiral(900), spiral(450), [[0, 1, 0]]])
    np.savez(folder / "a.npz", points=np.concatenate(points) + origin, normals=normals)
    return folder / "a.npz"


def test_a_box_is_in_the_units_and_axes_of_the_file_however_far_it_lies(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "CAPACITY", 480)  # it is cut before the file is thinned while reading
    box = tuple(map(float, (*(FAR + [1.001, -1, -1]), *(FAR + [3, 1, 1]))))
    lines: list[str] = []
    placed = place_cloud(scene(tmp_path, FAR), up="z", cut=Cut(crop=box), report=lines.append)
    assert "--crop: 450 of 1,351 points lie inside" in lines
    assert not any("while reading" in line for line in lines)
    back = placed.cloud.positions @ placed.rotation + placed.origin
    assert np.all((back > box[:3]) & (back < box[3:]))


def test_objects_are_cut_out_before_they_are_cleaned_and_thinned(tmp_path):
    cloud, lines = read(scene(tmp_path), cut=Cut(object="2"), clean="auto", num_points=200)
    assert np.linalg.norm(cloud.positions - [2, 0, 0], axis=1).max() < 0.31
    assert [line.split()[0] for line in lines if not line.startswith("no ")] == ["--object:", "200"]
    assert len(read_cloud(scene(tmp_path), cut=Cut(object="largest")).positions) == 900
    whole, lines = read(scene(tmp_path), clean="auto", num_points=50)
    assert np.abs(whole.positions).max() <= 2.31
    assert lines[-2:] == ["removed 1 outliers of 1,351 points", "50 of 1350 points kept, evenly spread"]


def test_a_box_and_an_object_are_cut_out_of_a_mesh(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "CUT_MESH", 2**12)
    triangle = "v {0} 0 0\nv {1} 0 0\nv {0} 1 0\n"
    (tmp_path / "a.obj").write_text(triangle.format(0, 1) + triangle.format(5, 7) + "f 1 2 3\nf 4 5 6\n")
    for cut in (Cut(crop=(-1.0, -1.0, -1.0, 2.0, 2.0, 2.0)), Cut(object="2")):
        cloud = read_cloud(tmp_path / "a.obj", cut=cut, num_points=300)
        assert len(cloud.positions) == 300
        assert cloud.positions[:, 0].max() <= 1
    with pytest.raises(ValueError, match=r"a\.obj: --crop 8 8 8 9 9 9: none of the"):
        read_cloud(tmp_path / "a.obj", cut=Cut(crop=(8.0, 8.0, 8.0, 9.0, 9.0, 9.0)))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"object": "smallest"}, "--object must be largest or a number from 1, got 'smallest'"),
        ({"object": "0"}, "--object must be largest or a number from 1, got '0'"),
        ({"crop": (1.0, 0.0, 0.0, 0.0, 1.0, 1.0)}, "--crop takes xmin .* zmax, each min up to its max"),
        ({"crop": (np.nan, 0.0, 0.0, 1.0, 1.0, 1.0)}, "--crop takes xmin ymin zmin xmax ymax zmax"),
        ({"up": "w"}, "up must be one of y, -y, z, -z, x, -x, auto, got 'w'"),
        ({"num_points": 0}, "num_points must be a whole number of at least 1, got 0"),
    ],
)
def test_options_that_make_no_sense_are_refused_before_the_file_is_touched(options, expected):
    with pytest.raises(ValueError, match=expected):
        read_cloud("absent.ply", **options) if options.keys() & {"up", "num_points"} else Cut(**options)
