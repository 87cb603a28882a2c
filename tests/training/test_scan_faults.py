"""What the faults of scans do to clouds whose answer is known."""

import numpy as np

from spnr_jax.surfels.sides import spiral
from spnr_jax.training import scan_faults


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_faults_change_what_their_names_say_and_nothing_else():
    points, values = spiral(4000), {"roughness": np.arange(4000.0), "metallic": np.ones(4000)}
    moved, same = scan_faults.add_noise(points, values, rng(), sigma=0.02)
    assert same is values
    np.testing.assert_allclose((moved - points).std(), 0.02, rtol=0.05)
    more, columns = scan_faults.add_outliers(points, values, rng(), share=0.02)
    assert len(more) == len(columns["roughness"]) == 4080
    np.testing.assert_array_equal(more[:4000], points)
    flat = scan_faults.drop_materials(points, values, rng())[1]
    assert [set(flat[name]) for name in ("roughness", "metallic", "materials_known")] == [{0.5}, {0.0}, {0.0}]
    moved = scan_faults.misregister(points, values, rng(), sigma=0.01)[0] - points
    apart = np.linalg.norm(moved, axis=1) > 1e-9
    assert 0.3 < apart.mean() < 0.7
    np.testing.assert_allclose(moved[apart], np.broadcast_to(moved[apart][0], moved[apart].shape), atol=1e-12)
    left, columns = scan_faults.drop_balls(points, values, rng(), balls=3)
    rows = columns["roughness"].astype(int)
    np.testing.assert_array_equal(points[rows], left)
    gone = np.setdiff1d(np.arange(4000), rows)
    assert 0 < len(gone) < 400
    assert np.linalg.norm(points[gone][:, None] - left[None], axis=-1).min(axis=1).max() > 0.03  # a hole


def test_colours_in_light_are_darkest_where_the_lamp_grazes_and_never_brighter():
    points = spiral(4000)
    values = {"base_color": np.full((4000, 3), 0.6), "normals": points}
    shade = scan_faults.bake_light(points, values, rng())[1]["base_color"][:, 0] / 0.6
    cosine = np.abs(points @ (lamp := rng().normal(size=3)) / np.linalg.norm(lamp))
    assert shade.max() <= 1
    order = np.argsort(cosine)
    assert (np.diff(shade[order]) >= -1e-12).all()
    assert 0.2 < 1 - shade.min() < 0.75


def test_a_random_scan_is_a_function_of_its_generator_and_keeps_columns_beside_points():
    points = spiral(3000).astype(np.float32)
    values = {"base_color": np.full((3000, 3), 0.5), "roughness": np.full(3000, 0.3), "metallic": np.zeros(3000)}
    values["normals"] = points
    scans_of = [scan_faults.random_scan(points, values, np.random.default_rng(seed)) for seed in range(12)]
    for seed, (positions, columns) in enumerate(scans_of):
        assert all(len(column) == len(positions) > 0 for column in columns.values())
        again = scan_faults.random_scan(points, values, np.random.default_rng(seed))[0]
        np.testing.assert_array_equal(again, positions)
    assert len({len(positions) for positions, _ in scans_of}) > 3
    assert 0 < sum("materials_known" in columns for _, columns in scans_of) < 12


def test_scanners_see_less_the_fewer_they_are_and_only_the_outside():
    points = np.concatenate([spiral(4000), 0.5 * spiral(1000)])
    values = {"roughness": np.arange(5000.0)}
    seen = [scan_faults.simulate_scanners(points, values, rng(), scanners=n) for n in (1, 3, 20)]
    counts = [len(positions) for positions, _ in seen]
    assert 1000 < counts[0] < 2000
    assert counts == sorted(counts)
    for positions, columns in seen:
        assert np.mean(np.linalg.norm(positions, axis=1) > 0.9) > 0.95  # an empty pixel lets through
        np.testing.assert_array_equal(points[columns["roughness"].astype(int)], positions)
    assert counts[2] > 3900


def test_uneven_density_thins_one_end():
    thin = scan_faults.thin_unevenly(spiral(20000), {}, rng())[0]
    assert 0.2 < len(thin) / 20000 < 0.6
    along = np.sort(thin @ rng().normal(size=3))
    low, high = np.count_nonzero(along < along[0] + 0.3), np.count_nonzero(along > along[-1] - 0.3)
    assert low > 3 * high
