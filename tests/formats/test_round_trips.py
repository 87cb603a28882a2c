"""One table of points through a writer of each format: it comes back, in pieces, without broken rows, not cut off."""

import numpy as np
import pytest
from support.point_clouds import SRGB, read
from support.point_tables import BROKEN, SOUND, WHOLE, WRITERS, written

from spnr_jax.formats import las, npz, ply, text
from spnr_jax.formats.point_files import column_pieces

PIECED = ("ascii.ply", "little.ply", "big.ply", "ascii.pcd", "binary.pcd", "a.xyz", "a.csv", "a.npy", "a.las")
ANNOUNCED = [name for name in WRITERS if name.rpartition(".")[2] in "ply pcd npy npz las laz off glb"]
ROUGH = [name for name in WRITERS if name.rpartition(".")[2] in "ply pcd xyz csv npy npz"]


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
