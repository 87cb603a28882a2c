"""What `spnr-data check` says of splits that let a product's colours leak; damaged files: test_generate.py."""

import pytest

from data_gen.store.check import variant_faults

DETAILS = {
    "lamp": {"product": "lamp", "variant": 0},
    "lamp--1": {"product": "lamp", "variant": 1},
    "sofa": {"product": "sofa", "variant": 0},
    "sofa--1": {"product": "sofa", "variant": 1},
}


def write_splits(folder, **splits):
    (folder / "splits").mkdir()
    for split in ("train", "val", "test"):
        (folder / "splits" / f"{split}.txt").write_text("".join(f"{name}\n" for name in splits.get(split, [])))
    return folder


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
def test_the_colour_variants_of_a_product_may_only_train_and_only_together(tmp_path, splits, faults):
    assert variant_faults(write_splits(tmp_path, **splits), DETAILS) == faults
