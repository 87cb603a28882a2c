"""The study of scans: whole on one ball, and what the faults do to clouds whose answer is known."""

import json

import numpy as np
import pytest
from support import tiny_dataset, tiny_surfels

from experiments.comparison import scan_faults
from experiments.studies import scans
from spnr_jax.surfels.visibility import spiral

SPLITS = {"train": (), "val": (), "test": ("ball_000000",)}


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.ci
def test_the_study_ends_with_a_table_and_pictures_and_goes_on_where_it_stopped(tmp_path):
    folder = tiny_dataset.write_dataset(tmp_path / "set", SPLITS, tiny_surfels.SIZE)
    options = scans.ScansStudy(
        data=folder,
        out=tmp_path / "out",
        run=str(tiny_surfels.run()),
        counts=(32,),
        noise=(0.02,),
        outliers=(0.1,),
        scanners=(2,),
        views=1,
    )
    scans.main(options)
    results = json.loads((tmp_path / "out" / "results.json").read_text())["objects"]
    faults = ["clean", "noise 2.0%", "outliers 10%", "2 scanners", "colours alone", "uneven density"]
    assert list(results) == [f"32, {fault}" for fault in faults]
    (clean,) = results["32, clean"]
    assert np.isfinite(clean["off"]).all()
    assert clean["auto"] == clean["off"]
    assert clean["left"] == 1
    assert results["32, outliers 10%"][0]["left"] == 1.1
    assert (tmp_path / "out" / "gallery.png").is_file()
    kept = sorted((tmp_path / "out" / "scores").rglob("*.json"))
    before = [path.stat().st_mtime_ns for path in kept]
    scans.main(options)
    assert [path.stat().st_mtime_ns for path in kept] == before


def test_faults_change_what_their_names_say_and_nothing_else():
    points, values = spiral(4000), {"roughness": np.arange(4000.0), "metallic": np.ones(4000)}
    moved, same = scan_faults.noisy(points, values, rng(), sigma=0.02)
    assert same is values
    np.testing.assert_allclose((moved - points).std(), 0.02, rtol=0.05)
    more, columns = scan_faults.with_outliers(points, values, rng(), share=0.02)
    assert len(more) == len(columns["roughness"]) == 4080
    np.testing.assert_array_equal(more[:4000], points)
    flat = scan_faults.colours_alone(points, values, rng())[1]
    assert set(flat["roughness"]) == {0.5}
    assert set(flat["metallic"]) == {0.0}


def test_scanners_see_less_the_fewer_they_are_and_only_the_outside():
    points = np.concatenate([spiral(4000), 0.5 * spiral(1000)])
    values = {"roughness": np.arange(5000.0)}
    seen = [scan_faults.scanned(points, values, rng(), scanners=n) for n in (1, 3, 20)]
    counts = [len(positions) for positions, _ in seen]
    assert 1000 < counts[0] < 2000
    assert counts == sorted(counts)
    for positions, columns in seen:
        assert np.mean(np.linalg.norm(positions, axis=1) > 0.9) > 0.95  # an empty pixel lets through
        np.testing.assert_array_equal(points[columns["roughness"].astype(int)], positions)
    assert counts[2] > 3900


def test_uneven_density_thins_one_end():
    thin = scan_faults.uneven(spiral(20000), {}, rng())[0]
    assert 0.2 < len(thin) / 20000 < 0.6
    along = np.sort(thin @ rng().normal(size=3))
    low, high = np.count_nonzero(along < along[0] + 0.3), np.count_nonzero(along > along[-1] - 0.3)
    assert low > 3 * high
