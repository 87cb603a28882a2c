"""The preset `tiny` shrunken to the painted data set, for experiments that train several variants of it."""

import contextlib
import dataclasses
import json

import pytest

from spnr_jax import cli, presets
from support import tiny_dataset

L1_ONLY = dataclasses.replace(
    tiny_dataset.CONFIG, loss=dataclasses.replace(tiny_dataset.CONFIG.loss, adversarial_weight=0.0)
)
CLOCKED = ("training_seconds", "ms_per_step", "ms_per_view")


@contextlib.contextmanager
def shrunken():
    """The preset `tiny` is L1_ONLY, and compilations are not kept on disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(presets.PRESETS, "tiny", lambda: L1_ONLY)
        patch.setattr(cli, "set_up_jax", lambda **_: None)
        yield


def results_of(out):
    """results.json without the costs that a clock decides."""
    results = json.loads((out / "results.json").read_text())
    for row in results["variants"].values():
        for name in CLOCKED:
            del row[name]
    return results


def check_conditions(out):
    """What the numbers stand on is in the results, and the pictures are pictures."""
    results = results_of(out)
    assert {"hardware", "seeds", "preset", "metrics", "data"} <= results.keys()
    for name in ("gallery.png", "differences.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")


def goes_on(main, options):
    """Called again, a study measures nothing again: the scores that it keeps stay as they are."""
    kept = [path for path in (options.out / "scores").rglob("*.json") if path.name != "asked.json"]
    assert kept
    before = [path.stat().st_mtime_ns for path in kept]
    main(options)
    assert [path.stat().st_mtime_ns for path in kept] == before


def forbidden(*_, **__):
    """Stands for what a finished experiment does not do again."""
    raise AssertionError("something was made again")
