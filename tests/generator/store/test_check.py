"""What `spnr-data check` says of objects; damaged files: test_generate.py."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support import tiny_dataset

from data_gen.store.check import object_faults, read_splits, split_faults

ITEM = tiny_dataset.one_object()
SETTINGS = {"views": tiny_dataset.VIEWS, "resolution": tiny_dataset.SIZE, "points": tiny_dataset.POINTS}
WHOLE = {"files": {}}
LIGHTS = np.ones((tiny_dataset.VIEWS, 32, 64, 3), np.float32)
DARK = LIGHTS * np.array([1, 0, 1], np.float32)[:, None, None, None]


def moved(**changes):
    """The object with other columns of its points."""
    return replace(ITEM, cloud=replace(ITEM.cloud, **changes))


@pytest.mark.parametrize(
    ("item", "details", "expected"),
    [
        (ITEM, WHOLE, None),
        (ITEM, {}, "object.json: expected the checksums"),
        (ITEM, WHOLE | {"files": {"points.ply": "0"}}, "points.ply has another checksum"),
        (replace(ITEM, images=ITEM.images[:2]), WHOLE, r"expected \(views, resolution\) \(3, 24\), got \(2, 24\)"),
        (ITEM, WHOLE | {"files": {"lights.npz": None}}, "lights.npz is there"),
        (replace(ITEM, lights=LIGHTS), WHOLE | {"files": {"lights.npz": None}}, None),
        (replace(ITEM, lights=DARK), WHOLE | {"files": {"lights.npz": None}}, "view 1 is lit by a black map"),
        (moved(positions=2 * ITEM.cloud.positions), WHOLE, "outside the unit sphere"),
        (moved(normals=None), WHOLE, "normals are not of length 1"),
        (moved(roughness=ITEM.cloud.roughness - 1), WHOLE, r"outside \[0, 1\]"),
    ],
)
def test_what_is_wrong_with_an_object_is_named(item, details, expected):
    faults = object_faults(replace(tiny_dataset.dataset(), settings={"settings": SETTINGS}), item, details)
    assert bool(faults) == (expected is not None), faults
    assert expected is None or re.search(expected, faults[0])


def test_every_missing_list_and_every_object_that_is_listed_twice_or_nowhere_is_named(tmp_path):
    splits, faults = read_splits(tmp_path)
    assert [fault.partition(".txt")[0].rpartition("/")[2] for fault in faults] == ["train", "val", "test"]
    assert splits == {}
    found = split_faults({"train": ["a", "b", "a"], "test": ["c"]}, {"a", "b", "d"})
    assert [fault.partition(" (")[0] for fault in found] == [
        "splits: a is listed more than once",
        "splits: c is listed but has no folder",
        "splits: d is in no split",
    ]
