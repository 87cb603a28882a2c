"""One table of points through a writer of each format: it comes back, in pieces, without broken rows, not cut off."""

from typing import NamedTuple

import numpy as np
import pytest
from support import pcd_files
from support.gltf_files import GltfBuilder
from support.point_clouds import SRGB, ply_bytes, read, write

from spnr_jax.formats import las, npz, ply, text
from spnr_jax.formats.point_files import column_pieces


class Table(NamedTuple):
    """Positions (12, 3) that every format holds exactly, levels (12, 3) of red green blue, roughness (12,)."""

    positions: np.ndarray
    levels: np.ndarray
    roughness: np.ndarray


rng = np.random.default_rng(0)
WHOLE = Table(np.round(rng.uniform(-64, 64, (12, 3))) / 8, rng.integers(0, 256, (12, 3)), np.arange(12) / 16)
WHOLE.levels[:2] = [[255, 5, 188], [0, 9, 64]]
BROKEN = WHOLE._replace(positions=WHOLE.positions.copy())
BROKEN.positions[[1, 3, 5], [0, 1, 2]] = np.nan, -np.inf, 1e39
SOUND = np.delete(np.arange(12), [1, 3, 5])


def as_ply(form: str, newline: str = "\n"):
    names = ["z", "red", "x", "label", "green", "y", "blue", "roughness"]
    kinds = {"red": "uchar", "green": "uchar", "blue": "uchar", "label": "short"}

    def content(table):
        columns = dict(zip(["x", "y", "z", "red", "green", "blue"], [*table.positions.T, *table.levels.T], strict=True))
        columns |= {"roughness": table.roughness, "label": np.arange(12) - 6}
        rows = list(zip(*(columns[name].tolist() for name in names), strict=True))
        return ply_bytes(form, newline, rows, [(name, kinds.get(name, "double")) for name in names])

    return content


def as_pcd(encoding: str, newline: str = "\n"):
    def content(table):
        rows = np.zeros(12, pcd_files.LAYOUT)
        with np.errstate(over="ignore"):
            rows["x"], rows["y"], rows["z"] = table.positions.T
        rows["rgb"] = pcd_files.packed(table.levels)
        rows["roughness"] = table.roughness
        return pcd_files.content(encoding, rows, newline)

    return content


def as_text(separator: str, header: str = "", factor: float = 1, start: str = "", columns: int = 8):
    def content(table):
        rows = np.column_stack([table.positions, table.levels * factor, table.roughness, np.zeros(12)])[:, :columns]
        return header + "".join(start + separator.join(f"{v:.17g}" for v in row) + "\n" for row in rows)

    return content


def as_numpy(path, table):
    if path.suffix == ".npz":
        columns = {"xyz": table.positions, "rgb": table.levels.astype(np.uint8), "roughness": table.roughness[:, None]}
        np.savez_compressed(path, **columns, notes=np.array([{}]))
    else:
        rows = np.zeros(12, [(name, "f8" if name in "xyz" or len(name) > 5 else "u1") for name in FIELDS])
        for name, column in zip(FIELDS, [*table.positions.T, *table.levels.T, table.roughness], strict=True):
            rows[name] = column
        np.save(path, rows)


def as_scan(path, table):
    laspy = pytest.importorskip("laspy")
    scan = laspy.LasData(laspy.LasHeader(point_format=7, version="1.4"))
    scan.header.scales = [0.125] * 3
    scan.x, scan.y, scan.z = table.positions.T
    scan.red, scan.green, scan.blue = (257 * table.levels.T).astype(np.uint16)
    scan.write(path)


def as_scene(path, table):
    builder, (red, green, blue) = GltfBuilder(), SRGB[table.levels].T
    colors = np.stack([red, green, blue, np.ones(12)], axis=-1).astype("f4")
    with np.errstate(over="ignore"):
        points = builder.primitive((table.positions - [0, 0, 2]).astype("f4"), None, mode=0, COLOR_0=colors)
    builder.mesh(points, translation=[0, 0, 2])
    builder.write(path)


FIELDS = ["x", "y", "z", "red", "green", "blue", "roughness"]
WRITERS = {
    "ascii.ply": as_ply("ascii"),
    "little.ply": as_ply("binary_little_endian"),
    "big.ply": as_ply("binary_big_endian"),
    "carriage.ply": as_ply("binary_little_endian", "\r\n"),
    "ascii.pcd": as_pcd("ascii"),
    "binary.pcd": as_pcd("binary"),
    "carriage.pcd": as_pcd("binary", "\r\n"),
    "packed.pcd": as_pcd("binary_compressed"),
    "a.xyz": as_text(" "),
    "a.csv": as_text(",", "x,y,z,r,g,b,rough,metal\n"),
    "unit.txt": as_text(";", "//X;Y;Z;diffuse_red;diffuse_green;diffuse_blue\n", 1 / 255, columns=6),
    "a.npy": as_numpy,
    "a.npz": as_numpy,
    "a.las": as_scan,
    "a.laz": as_scan,
    "a.obj": as_text(" ", "# points\n", 1 / 255, "v ", 6),
    "a.off": as_text(" ", "COFF\n12 0 0\n", columns=6),
    "a.glb": as_scene,
    "a.gltf": as_scene,
}
PIECED = ("ascii.ply", "little.ply", "big.ply", "ascii.pcd", "binary.pcd", "a.xyz", "a.csv", "a.npy", "a.las")
ANNOUNCED = [name for name in WRITERS if name.rpartition(".")[2] in "ply pcd npy npz las laz off glb"]
ROUGH = [name for name in WRITERS if name.rpartition(".")[2] in "ply pcd xyz csv npy npz"]


def written(folder, name, table):
    """A file of a table."""
    writer = WRITERS[name]
    if writer in (as_numpy, as_scan, as_scene):
        writer(folder / name, table)
        return folder / name
    return write(folder, name, writer(table))


@pytest.mark.parametrize("name", WRITERS)
def test_a_table_comes_back_from_every_format_with_its_colours_linear(tmp_path, name):
    cloud, lines = read(written(tmp_path, name, WHOLE))
    np.testing.assert_array_equal(cloud.positions, WHOLE.positions)
    np.testing.assert_allclose(cloud.base_color, SRGB[WHOLE.levels], atol=1e-5)
    np.testing.assert_allclose(cloud.roughness, WHOLE.roughness if name in ROUGH else 0.5)
    assert any(line.startswith("no roughness") for line in lines) == (name not in ROUGH)


@pytest.mark.parametrize("name", PIECED)
def test_pieces_are_small_and_together_the_whole_file(tmp_path, name, monkeypatch):
    path = written(tmp_path, name, WHOLE)
    for module, limit, size in ((ply, "PIECE_LINES", 5), (text, "PIECE_LINES", 5), (npz, "PIECE_BYTES", 5 * 35)):
        monkeypatch.setattr(module, limit, size)
    monkeypatch.setattr(ply, "PIECE_BYTES", 5 * 31)
    monkeypatch.setattr(las, "PIECE_BYTES", 5 * 36)
    sizes = [len(next(iter(piece.values()))) for piece in column_pieces(path)]
    assert len(sizes) > 2
    assert sum(sizes) == 12
    np.testing.assert_array_equal(read(path)[0].positions, WHOLE.positions)


@pytest.mark.parametrize("name", [name for name in WRITERS if not name.startswith(("a.la",))])
def test_rows_without_finite_numbers_are_left_out_and_counted_in_one_line(tmp_path, name):
    cloud, lines = read(written(tmp_path, name, BROKEN))
    np.testing.assert_array_equal(cloud.positions, WHOLE.positions[SOUND])
    np.testing.assert_allclose(cloud.base_color, SRGB[WHOLE.levels[SOUND]], atol=1e-5)
    left_out = [line for line in lines if "left out" in line]
    assert left_out == ["3 of 12 points left out: NaN, infinity or too large a number"]


@pytest.mark.parametrize("name", ANNOUNCED)
def test_what_says_how_much_it_holds_is_refused_wherever_it_is_cut(tmp_path, name):
    path = written(tmp_path, name, WHOLE)
    whole = path.read_bytes()
    for length in np.linspace(0, 0.8 * len(whole), 12, dtype=int):
        path.write_bytes(whole[:length])
        with pytest.raises(
            ValueError, match=r"empty|is cut off|cut off|broken|truncated|not an? |annou|expec"
        ) as refused:
            read(path)
        assert str(refused.value).startswith(f"{path}: ")
        assert "\n" not in str(refused.value)
