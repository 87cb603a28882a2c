"""What `spnr-data check` says of leaking splits and of lights; damaged files: test_generate.py."""

import io
import re

import numpy as np
import pytest

from data_gen.store.check import light_faults, object_faults, variant_faults
from data_gen.store.layout import ObjectRecord

DETAILS = {
    "lamp": {"product": "lamp", "variant": 0},
    "lamp--1": {"product": "lamp", "variant": 1},
    "sofa": {"product": "sofa", "variant": 0},
    "sofa--1": {"product": "sofa", "variant": 1},
}


@pytest.mark.parametrize(
    ("splits", "faults"),
    [
        ({"train": ["lamp", "lamp--1", "sofa", "sofa--1"]}, []),
        ({"train": ["lamp", "lamp--1"], "test": ["sofa"]}, []),
        ({"train": ["lamp--1", "sofa"], "test": ["lamp"]}, ["splits: variants of lamp are in test and train"]),
        (
            {"train": ["lamp"], "val": ["sofa", "sofa--1"]},
            ["splits: sofa--1 is a colour variant, but in val; only training objects have any"],
        ),
        ({"train": ["lamp"]}, []),
    ],
)
def test_the_colour_variants_of_a_product_may_only_train_and_only_together(splits, faults):
    assert variant_faults(splits, DETAILS) == faults


def lights(height=32, value=1.0, dtype=np.float16):
    return np.full((2, height, 64, 3), value, dtype)


def npz(**arrays):
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (npz(lights=lights()), None),
        (npz(lights=lights(16)), r"expected floats \(2, 32, 64, 3\), got float16 \(2, 16, 64, 3\)"),
        (npz(lights=lights()[:1]), r"got float16 \(1, 32, 64, 3\)"),
        (npz(lights=lights(dtype=np.uint8)), "got uint8"),
        (npz(lights=lights(value=-1)), "negative or not finite"),
        (npz(lights=lights(value=np.nan)), "negative or not finite"),
        (npz(lights=lights() * np.arange(2, dtype=np.float16)[:, None, None, None]), "view 0 is lit by a black map"),
        (npz(maps=lights()), "none of the arrays lights"),
        (npz(lights=lights())[:-40], "broken or truncated"),
    ],
)
def test_the_lights_of_an_object_are_maps_of_radiance_one_for_each_view(tmp_path, content, fault):
    (tmp_path / "lights.npz").write_bytes(content)
    found = light_faults(tmp_path, True, views=2, own_lights=True)
    if fault is None:
        assert found == []
    else:
        (line,) = found
        assert re.search(fault, line), line


def test_an_object_whose_files_are_no_table_is_a_fault_of_its_own(tmp_path):
    nothing, details = np.zeros(0), {"files": None, "product": "lamp", "variant": 0}
    record = ObjectRecord(points=nothing, transforms={}, images=nothing, conditions=nothing, details=details)
    faults = object_faults(tmp_path, record, {}, own_lights=True)
    assert faults == ["object.json: expected files, product and variant"]


def test_lights_are_there_if_and_only_if_the_data_set_says_so(tmp_path):
    assert light_faults(tmp_path, False, views=2, own_lights=False) == []
    assert "is missing" in light_faults(tmp_path, False, views=2, own_lights=True)[0]
    assert "is there" in light_faults(tmp_path, True, views=2, own_lights=False)[0]
