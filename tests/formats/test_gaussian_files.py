"""Files of splats: what they say is what was written, by our reader and by plain ones."""

import gzip

import numpy as np
import pytest
from support import splat_balls

from spnr_jax.formats import gaussian_files
from spnr_jax.formats.point_files import parse_ply
from spnr_jax.surfels.gaussians import rotations

NOTE = "ball.ply, drawn by spnr_jax (surfels), light: room"


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_ply_holds_each_number_of_the_splats_turned_half_around(tmp_path, degree):
    splats, path = splat_balls.ball(50, degree), tmp_path / "ball.ply"
    size = gaussian_files.write_splats(path, splats, NOTE)
    assert path.stat().st_size == size
    columns, wanted = parse_ply(path.read_bytes()), gaussian_files.turn_half(splats)

    def found(*names):
        return np.stack([columns[name] for name in names], axis=-1)

    rest = (degree + 1) ** 2 - 1
    np.testing.assert_allclose(found(*"xyz"), splats.position * [1, -1, -1], atol=1e-6)
    np.testing.assert_allclose(np.exp(found("scale_0", "scale_1", "scale_2")), splats.scale, rtol=1e-4)
    np.testing.assert_allclose(1 / (1 + np.exp(-columns["opacity"])), splats.opacity, atol=1e-5)
    np.testing.assert_allclose(found("f_dc_0", "f_dc_1", "f_dc_2"), splats.harmonics[:, 0], atol=1e-6)
    for i in range(3 * rest):  # all of red, then green, then blue
        np.testing.assert_allclose(columns[f"f_rest_{i}"], wanted.harmonics[:, 1 + i % rest, i // rest], atol=1e-6)
    turns = rotations(found("rot_0", "rot_1", "rot_2", "rot_3"))
    np.testing.assert_allclose(turns, np.diag([1, -1, -1]) @ rotations(splats.rotation), atol=1e-5)
    assert f"comment {NOTE}".encode() in path.read_bytes()[:300]


def spz_places(content, count):
    """Positions: three numbers of 24 bits each, in fixed point."""
    low, middle, high = np.frombuffer(content, np.uint8, 9 * count, 16).reshape(-1, 3).T.astype(int)
    fixed = (low | middle << 8 | high << 16).reshape(count, 3)
    return np.where(fixed >= 2**23, fixed - 2**24, fixed) * 2.0 ** -content[13]


def test_an_spz_holds_what_its_format_says():
    splats = splat_balls.ball(50, 1)
    content = gzip.decompress(gaussian_files.spz_of(splats))
    magic, version, count = np.frombuffer(content, "<u4", 3)
    degree, bits = content[12:14]
    assert (magic, version, count, degree) == (0x5053474E, 3, 50, 1)
    assert len(content) == 16 + 50 * (9 + 1 + 3 + 3 + 4 + 9)
    np.testing.assert_allclose(spz_places(content, 50), splats.position, atol=2.0**-bits)


@pytest.mark.parametrize("name", ["out.obj", "out.glb", "out", "folder.ply"])
def test_another_suffix_or_a_folder_is_refused_in_one_line(tmp_path, name):
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(ValueError, match="splats|a folder") as refused:
        gaussian_files.write_splats(tmp_path / name, splat_balls.ball(10))
    assert "\n" not in str(refused.value)
    assert name in str(refused.value)
