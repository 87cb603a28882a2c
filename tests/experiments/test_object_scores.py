"""What the tables and the page of Table 1 show: the best of a column, the median view, names as they are."""

import json
import re

import numpy as np

from experiments.comparison import object_scores, page
from experiments.comparison.object_scores import Shown
from experiments.paper import table1_tables
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.score_tables import quality


def test_the_best_of_a_column_is_the_highest_or_for_errors_the_lowest():
    def row(**values):
        return {m: values.get(m) for m in table1_tables.METRICS} | {
            f"{m}_interval": None for m in table1_tables.METRICS
        }

    found = quality({"ours": row(psnr=20.0, flip=0.2), "npbg": row(psnr=21.0, flip=0.1)}, table1_tables.METRICS)
    best = {name: [cell.text for cell in cells if cell.best] for name, cells in found.items()}
    assert best == {"ours": [], "npbg": ["21.00", "0.100"]}


def test_the_view_that_is_shown_is_the_one_of_median_quality():
    pictures = evaluation.Pictures(image=np.arange(3.0)[:, None, None, None], acc=np.ones((3, 1, 1)))
    result = evaluation.ObjectResult(
        name="a",
        reference=np.arange(3.0)[:, None, None, None],
        pictures={"ours": pictures, "white": pictures},
        scores={"ours": {"psnr": np.array([3.0, 9.0, 4.0])}, "white": {"psnr": np.array([5.0, 6.0, 7.0])}},
    )
    shown = object_scores.shown_view(result)
    assert shown.view == shown.reference.item() == shown.images["white"].item() == 2
    assert shown.psnr == {"ours": 4.0, "white": 7.0}


def test_no_name_ends_the_script():
    name, grey = "</script><b>", np.full((4, 4, 3), 0.5)
    shown = Shown(name=name, view=0, reference=grey, images={"ours": grey}, psnr={"ours": 9.0})
    table = page.Table(title="t", heads=(), rows=())
    text = page.page("t", [table], [], [shown])
    (content,) = re.findall(r'<script type="application/json" id="pictures">(.*?)</script>', text, re.DOTALL)
    assert json.loads(content)["objects"][0]["name"] == name
