"""Files of splats: what they say is what was written, by our reader and by three.js in a headless Chromium.

Without a Chromium and npm's three (support/three_js.py) the latter tests are skipped.
"""

import dataclasses
import gzip

import numpy as np
import pytest
from support import chromium as chromium_of, splat_balls, three_js
from support.point_clouds import BALL, GREEN, LINEAR, packed_splats, write

from spnr_jax.config import Cut
from spnr_jax.formats import gaussian_files
from spnr_jax.formats.clouds import place_cloud, read_cloud
from spnr_jax.formats.point_files import parse_ply
from spnr_jax.kernels.imaging import srgb_to_linear
from spnr_jax.surfels.gaussians import C0, rotation_matrices

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
    turns = rotation_matrices(found("rot_0", "rot_1", "rot_2", "rot_3"))
    np.testing.assert_allclose(turns, np.diag([1, -1, -1]) @ rotation_matrices(splats.rotation), atol=1e-5)
    assert f"comment {NOTE}".encode() in path.read_bytes()[:300]


@pytest.mark.parametrize("name", ["out.obj", "out.glb", "out", "folder.ply"])
def test_another_suffix_or_a_folder_is_refused_in_one_line(tmp_path, name):
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(ValueError, match="splats|a folder") as refused:
        gaussian_files.write_splats(tmp_path / name, splat_balls.ball(10))
    assert "\n" not in str(refused.value)
    assert name in str(refused.value)


@pytest.mark.parametrize("factor", [1e-4, 1e5])
def test_splats_of_a_size_that_no_spz_can_hold_are_refused_there(tmp_path, factor):
    splats = splat_balls.ball(50)
    sized = dataclasses.replace(splats, position=factor * splats.position, scale=factor * splats.scale)
    with pytest.raises(ValueError, match="cannot hold splats .* units wide, .*: write a .ply, or choose another unit"):
        gaussian_files.write_splats(tmp_path / "a.spz", sized)
    assert gaussian_files.write_splats(tmp_path / "a.ply", sized)
    assert not (tmp_path / "a.spz").exists()


# Read as clouds


def test_splats_come_back_upright_from_either_file(tmp_path):
    splats = splat_balls.ball(300)
    places = np.asarray(splats.position)
    stands = splats.replace(position=np.stack([places[:, 0], np.maximum(places[:, 1], -0.1), places[:, 2]], axis=1))
    for name in ("a.ply", "a.spz"):
        gaussian_files.write_splats(str(tmp_path / name), stands)
        placed = place_cloud(tmp_path / name, up="auto")
        np.testing.assert_allclose(placed.cloud.positions, stands.position, atol=1e-3)


def test_our_own_spz_files_and_those_of_version_2_are_read_and_others_are_named(tmp_path):
    splats, path = splat_balls.ball(50), tmp_path / "a.spz"
    content = gzip.decompress(gaussian_files.spz_of(splats))
    versions = {number: content[:4] + bytes([number]) + content[5:] for number in (1, 2, 3, 4)}
    for unpacked in (gzip.compress(versions[2]), gzip.compress(versions[3]), content):
        path.write_bytes(unpacked)
        np.testing.assert_allclose(read_cloud(path, cut=Cut(keep_noise=True)).positions, splats.position, atol=1e-5)
        assert len(read_cloud(path).positions) == np.count_nonzero(np.round(splats.opacity * 255) >= 51)
    refused = {number: f"of version {number}; versions 2 and 3 can be read: convert it to .ply" for number in (1, 4)}
    for data, reason in (*((versions[n], refused[n]) for n in refused), (content[:300], "announces 50 splats")):
        path.write_bytes(gzip.compress(data))
        with pytest.raises(ValueError, match=reason):
            read_cloud(path)
    path.write_bytes(gzip.compress(content)[:-20])
    with pytest.raises(ValueError, match="is cut off, or larger"):
        read_cloud(path)


def test_compressed_splats_in_a_ply_are_unpacked(tmp_path):
    content = packed_splats(BALL, 0x28AA3CFF)
    cloud = read_cloud(write(tmp_path, "a.ply", content))
    np.testing.assert_allclose(cloud.positions, BALL, atol=1.1e-3)
    np.testing.assert_allclose(cloud.base_color, np.broadcast_to(LINEAR, (420, 3)), atol=2e-3)
    ranges = b"".join(b"property float %s_%s\n" % (end, x) for end in (b"min", b"max") for x in (b"r", b"g", b"b"))
    boxes = np.tile(np.repeat(np.float32([-1, 1, 0.25, 0.75]), 3), 2).tobytes()  # of two chunks: places, then colours
    content = content.replace(b"element vertex", ranges + b"element vertex")
    content = content.replace(np.tile(np.repeat(np.float32([-1, 1]), 3), 2).tobytes(), boxes)
    base_color = read_cloud(write(tmp_path, "a.ply", content)).base_color
    np.testing.assert_allclose(base_color[0], srgb_to_linear(0.25 + np.array(GREEN) / 510), atol=2e-3)
    for old, new, reason in (
        (b"chunk 2", b"chunk 1", "compressed splats .index 1"),
        (b"min_x", b"low_x", "compressed splats .there is no 'min_x'"),
        (b"element chunk", b"element boxes", "no PLY element 'chunk', only boxes, vertex"),
    ):
        with pytest.raises(ValueError, match=reason):
            read_cloud(write(tmp_path, "a.ply", content.replace(old, new)))


# In three.js

SCRIPT = """
import { SPZLoader } from "add/loaders/SPZLoader.js";
import { GaussianSplatPLYLoader } from "add/loaders/GaussianSplatPLYLoader.js";
const read = { spz: await new SPZLoader().loadAsync("/ball.spz"),
               ply: await new GaussianSplatPLYLoader().loadAsync("/ball.ply") };
for (const [name, { attributes }] of Object.entries(read))
  read[name] = Object.fromEntries(Object.entries(attributes).map(([key, values]) => [key, Array.from(values.array)]));
window.shown = read;
"""


SPLATS = splat_balls.ball(500)


@pytest.fixture(scope="module")
def read_in_three():
    """What three.js reads in both files, its console being silent."""
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    files = {"/ball.spz": gaussian_files.spz_of(SPLATS), "/ball.ply": gaussian_files.ply_of(SPLATS, "a ball")}
    with three_js.run(playwright, SCRIPT, files, 64) as (tab, said):
        found = tab.evaluate("window.shown")
    assert not said
    return found


@chromium_of.needed
@three_js.needed_with_splats
@pytest.mark.ci  # it opens a browser
@pytest.mark.parametrize(("kind", "coarser"), [("spz", 1), ("ply", 0)])
def test_three_reads_places_shapes_colours_and_opacities_as_they_were_written(read_in_three, kind, coarser):
    found = {name: np.array(values) for name, values in read_in_three[kind].items()}
    wanted = SPLATS if kind == "spz" else gaussian_files.turn_half(SPLATS)
    axes = rotation_matrices(wanted.rotation) * wanted.scale[:, None, :]
    shape = np.einsum("nij,nkj->nik", axes, axes)[:, *np.triu_indices(3)]
    color = np.concatenate([0.5 + C0 * wanted.harmonics[:, 0], wanted.opacity[:, None]], axis=1)
    np.testing.assert_allclose(found["position"].reshape(-1, 3), wanted.position, atol=1e-6 + 1e-6 * coarser)
    largest = np.abs(shape).max()
    np.testing.assert_allclose(found["covariance"].reshape(-1, 6), shape, atol=(1e-5 + 0.07 * coarser) * largest)
    colors, step = found["color"].reshape(-1, 4) / 255, (1 + 0.6 * coarser) / 255
    np.testing.assert_allclose(colors, np.clip(color, 0, 1), atol=step)
    words = found["sphericalHarmonics1"].astype(np.uint32)[:, None] >> np.array([0, 8, 16, 24]) & 255
    rest = (words.reshape(len(color), -1)[:, :9].astype(float) - 128) / 128
    np.testing.assert_allclose(
        rest, np.clip(wanted.harmonics[:, 1:].reshape(-1, 9), -1, 1), atol=(1 + 4 * coarser) / 128
    )
