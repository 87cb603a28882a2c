"""A table says the same in every form, and a folder of results is one request's and goes on where it stopped."""

import csv
import io
import re

import numpy as np
import pytest
from support import tiny_dataset

from experiments.comparison import results_folder
from experiments.comparison.result_tables import csv_text, latex, markdown
from spnr_jax.scoring.score_tables import Table, number, text

ROWS = (
    ("ours_1", (number(21.456, 2, (20.0, 22.5), best=True), number(0.25, 1, factor=100))),
    ("50 % & more", (number(None, 2), number(-1.0, 1, sign="+"))),
    ("absent", (text("not run: no solver"),)),
)
TABLE = Table(
    title="A title", heads=("PSNR, dB\N{NO-BREAK SPACE}\N{UPWARDS ARROW}", "share, %"), rows=ROWS, note="A note."
)


def test_markdown_has_a_row_for_each_row_all_as_wide_as_the_head():
    lines = [line for line in markdown([TABLE], ["how"]).splitlines() if line.startswith("|")]
    assert len(lines) == 2 + len(ROWS)
    assert {line.count("|") for line in lines} == {4}
    assert "**21.46** [20.00, 22.50]" in lines[2]
    assert [cell.strip() for cell in lines[3].split("|")[2:4]] == ["n/a", "-1.0"]


def test_latex_escapes_what_it_must_and_marks_the_best():
    found = latex([TABLE], ["how"])
    (body,) = re.findall(r"\\begin\{tabular\}.*?\\end\{tabular\}", found, re.DOTALL)
    assert {len(re.findall(r"(?<!\\)&", row)) for row in body.splitlines() if "&" in row} == {2}
    assert r"\textbf{21.46} {\tiny [20.00, 22.50]}" in body
    assert r"ours\_1" in body
    assert r"50 \% \& more" in body
    assert r"dB~$\uparrow$" in body
    assert r"\caption{A title. A note.}" in found
    assert not re.search(r"[\x01-\x03]", found)


def test_the_csv_holds_every_number_unrounded_with_its_interval():
    rows = list(csv.DictReader(io.StringIO(csv_text([TABLE]))))
    assert [(row["row"], row["column"], row["value"]) for row in rows] == [
        ("ours_1", "PSNR, dB \N{UPWARDS ARROW}", "21.456"),
        ("ours_1", "share, %", "25.0"),
        ("50 % & more", "share, %", "-1.0"),
    ]
    assert (rows[0]["low"], rows[0]["high"]) == ("20.0", "22.5")


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.json", {"b": [1, 2.5]}), ("a.npz", (np.arange(3.0), np.eye(2))), ("a.png", np.zeros((2, 3, 3), np.uint8))],
)
def test_what_was_made_is_read_and_not_made_again(name, content, tmp_path):
    calls = []
    for _ in range(2):
        found = results_folder.kept(tmp_path / "in" / name, lambda: calls.append(1) or content)
        for a, b in zip(found, content, strict=True):
            np.testing.assert_array_equal(a, b)
    assert calls == [1]


def test_a_folder_is_one_requests_of_one_data_set(tmp_path):
    dataset = tiny_dataset.dataset()
    for _ in range(2):
        results_folder.claim(tmp_path, "scores", {"seed": 0, "objects": ("a", "b")}, dataset)
    with pytest.raises(ValueError, match="holds scores with another seed; choose another --out"):
        results_folder.claim(tmp_path, "scores", {"seed": 1, "objects": ["a", "b"]}, dataset)
    with pytest.raises(ValueError, match="another of, data"):
        results_folder.claim(tmp_path, "pictures", {"seed": 0, "data": "another"})
