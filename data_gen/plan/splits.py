"""Which product is in which split, and which colour variants the training split gets.

Products (objects as their source holds them) are split, never variants: a colour variant is made of a training product
only and is in the training split with it. Products are ranked by a hash of (seed, id); the first are the test split,
the next the validation split, the rest train. A test list names the test split. A split file names any of the
splits; where it names no training objects, all others train. Only usable products are ranked: what cannot be rendered
is in no split and takes nobody's place.
"""

import csv
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from data_gen.store.layout import SPLITS
from spnr_jax.errors import UserError

Listed = Mapping[str, Sequence[str]]  # ids of the splits that the user names


def rank(ids: Sequence[str], seed: int, purpose: str) -> list[str]:
    """The ids in an order that depends on nothing but (purpose, seed, id)."""
    return sorted(ids, key=lambda name: hashlib.sha256(f"{purpose}/{seed}/{name}".encode()).digest())


def split_products(ids: Sequence[str], listed: Listed, seed: int, num_test: int, num_val: int) -> dict[str, list[str]]:
    """The sorted ids of each split, as the header of this file says."""
    usable = set(ids)
    if "train" in listed:
        return {split: sorted(usable & set(listed.get(split, ()))) for split in SPLITS}
    order = rank(ids, seed, "split")
    test = usable & set(listed["test"] if "test" in listed else order[:num_test])
    rest = [name for name in order if name not in test]
    val = usable & set(listed["val"] if "val" in listed else rest[:num_val])
    return {"train": sorted(set(rest) - val), "val": sorted(val), "test": sorted(test)}


def chosen_variants(products: Sequence[str], each: int, most: int | None, seed: int) -> list[tuple[str, int]]:
    """(training product, number from 1) of the colour variants, sorted: `each` a product, `most` in all.

    Where there are more than `most`, they are drawn by a hash of (seed, product, number).
    """
    names = {f"{product}/{number}": (product, number) for product in products for number in range(1, each + 1)}
    return sorted(names[name] for name in rank(list(names), seed, "variants")[:most])


def read_test_list(path: Path, known: set[str]) -> Listed:
    """The test split of a text file with one id per line; ValueError if it names an object that is not there."""
    try:
        ids = sorted(set(path.read_text().split()))
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--test-list {path}: not a readable text file ({error})") from None
    refuse_unknown(f"--test-list {path}", ids, known)
    return {"test": ids}


def read_split_file(path: Path, known: set[str], synset: str | None) -> Listed:
    """The splits of a JSON file {"train": [ids], "val": [ids], "test": [ids]} or of a CSV file.

    The CSV has columns id,split, or those of ShapeNet's all.csv, id,synsetId,subSynsetId,modelId,split, of which the
    rows of one synset count. ValueError if the file is neither, names an object twice or one that is not there.
    """
    try:
        text = path.read_text("utf-8")
        listed = splits_of_csv(text, synset) if path.suffix.lower() == ".csv" else json.loads(text)
    except (OSError, ValueError, RecursionError, csv.Error) as error:
        raise UserError(f"--split-file {path}: cannot be read ({error}); give .json or .csv") from None
    lists = listed.values() if isinstance(listed, dict) and listed.keys() <= set(SPLITS) else [None]
    if not all(isinstance(ids, list) and all(isinstance(name, str) for name in ids) for ids in lists):
        raise UserError(f"--split-file {path}: expected lists of ids named {', '.join(SPLITS)}")
    names = sorted(name for ids in listed.values() for name in ids)
    if not names:
        raise UserError(f"--split-file {path}: lists no objects{f' of synset {synset}' if synset else ''}")
    if twice := [name for name, after in zip(names, names[1:], strict=False) if name == after]:
        places = [split for split in SPLITS if twice[0] in listed.get(split, ())]
        raise UserError(f"--split-file {path}: {twice[0]} is listed more than once ({', '.join(places)})")
    refuse_unknown(f"--split-file {path}", names, known)
    return {split: sorted(ids) for split, ids in listed.items()}


def splits_of_csv(text: str, synset: str | None) -> dict[str, list[str]]:
    """The ids of each split of a CSV file's text."""
    listed: dict[str, list[str]] = {}
    for number, row in enumerate(csv.DictReader(text.splitlines()), start=2):
        name, split = row.get("modelId") or row.get("id"), row.get("split")
        if not name or split not in SPLITS:
            raise UserError(f"line {number}: expected columns id (or modelId) and split, one of {', '.join(SPLITS)}")
        if synset is None or row.get("synsetId", synset) == synset:
            listed.setdefault(split, []).append(name)
    return listed


def refuse_unknown(name: str, ids: Sequence[str], known: set[str]) -> None:
    """ValueError if an id is none of the known ones."""
    if unknown := [object_id for object_id in ids if object_id not in known]:
        raise UserError(f"{name}: no object {unknown[0]} ({len(unknown)} of {len(ids)} ids unknown)")
