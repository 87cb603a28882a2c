"""Clouds of more points than are wanted, or than the memory holds."""

import subprocess
import sys

import numpy as np
import pytest
from support.point_clouds import read, sphere_points

from spnr_jax.formats import clouds
from spnr_jax.formats.clouds import read_cloud


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


def test_of_a_cloud_beyond_the_capacity_a_sample_is_kept_while_reading_which_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "CAPACITY", 500)
    positions = sphere_points(1, 4000)
    np.savez(tmp_path / "a.npz", xyz=positions, normals=2 * positions, roughness=np.arange(4000) / 4000)
    cloud, lines = read(tmp_path / "a.npz")
    assert 250 <= len(cloud.mask) <= 500
    assert lines[0] == f"{len(cloud.mask)} of 4000 points kept while reading, drawn at random"
    assert "kept while reading" in read(tmp_path / "a.npz", clean="auto")[1][0]
    assert not any("outliers" in line for line in read(tmp_path / "a.npz", clean="auto")[1])  # where there are none
    source = np.round(cloud.roughness * 4000).astype(int)
    np.testing.assert_array_equal(cloud.positions, positions[source].astype(np.float32))
    np.testing.assert_allclose(cloud.normals, cloud.positions, atol=1e-6)
    few = read_cloud(tmp_path / "a.npz", num_points=20)
    np.testing.assert_allclose(few.normals, few.positions, atol=1e-6)
