"""The notebooks run, and the pictures that they hold were drawn by running them from top to bottom."""

import json
import warnings
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from support import tiny_untrained

FOLDER = Path(__file__).parents[1] / "notebooks"
NAMES = ("vmap_over_objects", "your_own_loss")


def cells(name, kind="code"):
    document = json.loads((FOLDER / f"{name}.ipynb").read_text())
    return [cell for cell in document["cells"] if cell["cell_type"] == kind]


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """The folder of the notebooks, beside what `make demo` leaves."""
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "runs" / "demo").mkdir(parents=True)
    (tmp_path / "runs" / "demo" / "paper").symlink_to(tiny_untrained.run())
    monkeypatch.chdir(tmp_path / "notebooks")
    with warnings.catch_warnings(), matplotlib.rc_context():
        matplotlib.use("agg")
        yield tmp_path
        plt.close("all")


def execute(name, old="", new=""):
    """The names that a notebook's code leaves, with one passage changed to another."""
    names = {"__name__": "__main__"}
    assert any(old in "".join(cell["source"]) for cell in cells(name))
    for number, cell in enumerate(cells(name)):
        source = "".join(cell["source"])
        exec(compile(source.replace(old, new) if old else source, f"{name}, code cell {number + 1}", "exec"), names)
    return names


@pytest.mark.ci
def test_vmap_over_objects_draws_every_object_from_every_side(workplace):
    names = execute("vmap_over_objects")
    drawn = np.asarray(names["draw"](names["objects"]))
    assert drawn.shape[:2] == (8, 4)
    alone = names["pictures"](names["each"][3])
    np.testing.assert_allclose(drawn[3], alone, atol=1e-4)
    assert len(plt.get_fignums()) == 2


@pytest.mark.ci
def test_your_own_loss_trains_with_both_losses(workplace):
    names = execute("your_own_loss", "SIZE, STEPS = 32, 80", "SIZE, STEPS = 16, 3")
    reference, *rows = (np.asarray(row) for row in names["rows"].values())
    assert len(rows) == 2
    assert all(row.shape == reference.shape == (6, 16, 16, 3) for row in rows)
    assert np.abs(rows[0] - rows[1]).max() > 1e-4, "the loss makes no difference"
    assert len(plt.get_fignums()) == 1


@pytest.mark.parametrize("name", NAMES)
def test_what_a_notebook_holds_was_produced_by_running_it_in_order(name):
    code = cells(name)
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert all(output["output_type"] in ("display_data", "execute_result") for output in outputs), "no warnings"
    assert any("image/png" in output["data"] for output in outputs)
    assert not any(str(Path.home()) in json.dumps(output) for output in outputs)
