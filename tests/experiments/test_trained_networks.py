"""The networks of a comparison are found in run folders and tables, named once each, and fit the data."""

import dataclasses
import hashlib
import shutil
from pathlib import Path

import pytest
from support import stand_ins, tiny_dataset

from experiments.comparison import trained_networks as methods
from experiments.comparison.trained_networks import Sources, networks
from spnr_jax.formats import data_sets
from spnr_jax.training import weights

PAPER = methods.LABELS["paper"]


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """What a table with two networks leaves behind."""
    folder = tmp_path_factory.mktemp("table")
    for name, preset in (("npbg", "npbg_tiny"), ("paper", "tiny")):
        shutil.copytree(stand_ins.fresh(preset), folder / "runs" / name)
    return folder


def test_networks_of_a_table_and_of_runs_are_named_after_their_methods_in_the_order_of_table_1(table):
    dataset = tiny_dataset.dataset()
    assert list(networks(Sources(table1=table), dataset)) == [PAPER, "NPBG"]
    found = networks(Sources(runs=(stand_ins.fresh("tiny"),), table1=table), dataset)
    assert list(found) == [f"{PAPER} (fresh, tiny)", f"{PAPER} (runs, paper)", "NPBG"]
    assert [network.has_depth for network in found.values()] == [True, True, False]
    assert found[f"{PAPER} (runs, paper)"].identity == found[f"{PAPER} (fresh, tiny)"].identity


def test_the_network_of_the_package_goes_by_its_name():
    found = networks(Sources(runs=(Path("surfels"),)), tiny_dataset.dataset())
    assert list(found) == [methods.LABELS["surfels"]]
    checksum = hashlib.sha256(weights.shipped().read_bytes()).hexdigest()
    assert [network.identity["config"] for network in found.values()] == [checksum]


def test_what_cannot_be_compared_is_refused_by_name(table, tmp_path):
    dataset = tiny_dataset.dataset()
    with pytest.raises(ValueError, match="--runs: name at least one"):
        networks(Sources(table1=tmp_path), dataset)
    with pytest.raises(ValueError, match="--runs: a run folder is named twice"):
        networks(Sources(runs=(stand_ins.fresh("tiny"),) * 2), dataset)
    larger = data_sets.open_dataset(tiny_dataset.write_dataset(tmp_path / "data", size=2 * tiny_dataset.SIZE))
    with pytest.raises(ValueError, match=r"images of 48 x 48 pixels, [^\n]*needs 24 x 24"):
        networks(Sources(table1=table), larger)
    with pytest.raises(ValueError, match="--objects: expected 1 or more, got 0"):
        methods.test_objects(dataset, 0)
    nothing = dataclasses.replace(dataset, splits={"test": ()})
    with pytest.raises(ValueError, match="the test split is empty"):
        methods.test_objects(nothing, None)


def test_points_are_always_the_first_ones():
    item = data_sets.read_object(tiny_dataset.dataset(), tiny_dataset.SPLITS["test"][0])
    assert (data_sets.first_points(item, 7).positions == item.cloud.positions[:7]).all()
    assert len(data_sets.first_points(item, 10_000).mask) == tiny_dataset.POINTS
