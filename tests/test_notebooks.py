"""The notebook runs, and the pictures that it holds were drawn by running it from top to bottom."""

import json
import warnings
from pathlib import Path

import jax
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from support import tiny_untrained

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "vmap_over_objects.ipynb"
CODE = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """The folder of the notebook, beside what `make demo` leaves."""
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "runs" / "demo").mkdir(parents=True)
    (tmp_path / "runs" / "demo" / "paper").symlink_to(tiny_untrained.run())
    monkeypatch.chdir(tmp_path / "notebooks")
    with warnings.catch_warnings(), matplotlib.rc_context():
        matplotlib.use("agg")
        yield tmp_path
        plt.close("all")


@pytest.mark.ci
def test_every_object_is_drawn_from_every_side(workplace):
    names = {"__name__": "__main__"}
    for number, cell in enumerate(CODE, start=1):
        exec(compile("".join(cell["source"]), f"code cell {number}", "exec"), names)
    drawn = np.asarray(names["draw"](names["objects"]))
    assert drawn.shape[:2] == (8, 4)
    np.testing.assert_allclose(drawn[3], jax.jit(names["pictures"])(names["each"][3]), atol=1e-4)
    assert len(plt.get_fignums()) == 2


def test_what_the_notebook_holds_was_produced_by_running_it_in_order():
    assert [cell["execution_count"] for cell in CODE] == list(range(1, len(CODE) + 1))
    outputs = [output for cell in CODE for output in cell["outputs"]]
    assert all(output["output_type"] in ("display_data", "execute_result") for output in outputs), "no warnings"
    assert any("image/png" in output["data"] for output in outputs)
    assert not any(str(Path.home()) in json.dumps(output) for output in outputs)
