"""The report is one page that shows what was scored and says which objects; metrics.json has a form to rely on."""

import base64
import dataclasses
import io
import json
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from support import tiny_dataset, tiny_untrained

from spnr_jax.scoring import report
from spnr_jax.scoring.evaluation import ObjectResult, Pictures
from spnr_jax.scoring.picture_scores import METRICS
from spnr_jax.scoring.report import write_report

VOID = {"meta", "img", "br"}
SETTINGS = {"model": {"widths": (64, 128), "sampling": {"num_coarse": 16}}, "light": "<studio & sky>", "augment": {}}


class Page(HTMLParser):
    """Texts of the page by element, its pictures and every address; fails on an element that is not closed."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.texts, self.pictures, self.links, self.tags = [], [], [], [], set()
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.links += [value for name, value in attrs if name in ("href", "xlink:href", "src", "action") and value]
        if tag == "img":
            content = base64.b64decode(dict(attrs)["src"].split(",")[1])
            self.pictures.append(np.asarray(Image.open(io.BytesIO(content))))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if data.strip():
            self.texts.append((self.open[-1], data.strip()))

    def all(self, tag: str) -> list[str]:
        return [text for name, text in self.texts if name == tag]


def row(seed: int) -> ObjectResult:
    rng = np.random.default_rng(seed)
    reference, others = (
        rng.uniform(size=(1, 12, 16, 3)),
        {"acc": np.eye(6, 8)[None], "depth": rng.uniform(2, 3, (1, 6, 8))},
    )
    pictures = {
        name: Pictures(image=rng.uniform(size=(1, 12, 16, 3)), **others) for name in ("ours", "splat", "nearest")
    }
    scores = {name: {"psnr": np.array([20.0 + i])} for i, name in enumerate(pictures)}
    return ObjectResult(name=f"object<{seed}>", reference=reference, pictures=pictures, scores=scores)


def table() -> dict:
    counts = {"objects": 3, "views": 30}
    return {
        "ours": {"psnr": 21.125, "psnr_interval": [20.5, 21.75], "ssim": 0.91234, "cpsnr": 17.5, "flip": 0.1, **counts},
        "white": {"psnr": 13.0, "psnr_interval": None, "ssim": 0.95, "cpsnr": None, "flip": 0.25, **counts},
        "splat": {"psnr": 18.0, "ssim": 0.8, "cpsnr": float("nan"), "flip": 0.05, **counts},
    }


FOUND = {"mean": 3.125, "interval": [-0.5, 6.75], "p_value": 0.0123}
METRICS_JSON = {
    "methods": table(),
    "ours_minus": {"splat": {"psnr": FOUND}, "white": {"psnr": FOUND | {"interval": None, "p_value": None}}},
    "seconds": {"train": 372.0, "total": 8000.0},
    "preset": "tiny",
    "steps": 99,
    "seed": 7,
    "hardware": "2 cores",
    "settings": {"split": "val", "networks": {"ours": {}}, "points": 24},
}


def write(tmp_path, gallery=None, **changes) -> Page:
    rows = [row(0), row(1)] if gallery is None else gallery
    write_report(tmp_path / "report.html", SETTINGS, METRICS_JSON | changes, rows)
    return Page((tmp_path / "report.html").read_text(encoding="utf-8"))


def test_the_page_is_one_file_without_addresses_or_scripts_and_the_same_bytes_again(tmp_path):
    page = write(tmp_path)
    (file,) = tmp_path.iterdir()
    assert all(link.startswith(("data:image/png;base64,", "#")) for link in page.links)
    assert not page.tags & {"script", "link", "iframe", "object", "a"}
    before = file.read_bytes()
    assert b"@import" not in before
    write(tmp_path)
    assert file.read_bytes() == before


def test_the_gallery_shows_every_picture_of_every_row_in_the_order_of_its_heads(tmp_path):
    page = write(tmp_path)
    assert len(page.pictures) == 12
    for shown, wanted in ((page.pictures[:6], row(0)), (page.pictures[6:], row(1))):
        for image, expected in zip(
            shown, [wanted.reference, *(x.image for x in wanted.pictures.values())], strict=False
        ):
            np.testing.assert_allclose(image / 255, expected[0], atol=0.51 / 255)
        assert (shown[4][np.eye(6, 8) == 0] == 255).all()
        np.testing.assert_array_equal(shown[5], 255 * np.eye(6, 8))
    heads = page.all("th")
    assert heads[:6] == ["Reference", "Ours", "Base-colour splat", "Nearest-point shading", "Depth", "Opacity"]
    assert "object<1>" in heads, "texts are shown as they are written"
    assert page.all("small")[:3] == ["20.0", "21.0", "22.0"]


def test_the_best_value_of_each_metric_alone_is_bold_and_what_is_missing_is_not_a_number(tmp_path):
    page = write(tmp_path)
    bold = page.all("b")
    assert [text for text in bold if not text.endswith(("dB", " s"))] == ["21.12", "17.50", "0.950", "0.050"]
    assert page.all("td").count("n/a") == 2
    assert not any("Opacity IoU" in text or "LPIPS" in text for text in page.all("th"))
    methods = {name: row | {"lpips": None} for name, row in table().items()}
    page = write(tmp_path, methods=methods | {"ours": table()["ours"] | {"lpips": 0.125}})
    assert "0.125" in page.all("b")
    assert page.all("td").count("n/a (pip install lpips)") == 2


def test_differences_have_a_sign_an_interval_and_a_test(tmp_path):
    page = write(tmp_path)
    assert {"Ours minus Base-colour splat", "Ours minus White image"} <= set(page.all("th"))
    assert page.all("td").count("+3.12") == 2
    assert {"[-0.50, +6.75]", "p = 0.012"} <= set(page.all("small"))
    sure = {"psnr": {"mean": 3.0, "interval": [2.0, 4.0], "p_value": 0.0001}}
    page = write(tmp_path, ours_minus={"splat": sure, "white": sure})
    assert "p < 0.001" in page.all("small")


NUMBERS = {"objects", "views", "cpsnr_views", *METRICS, *(f"{metric}_interval" for metric in METRICS)}


class TestEvaluation:
    @pytest.fixture
    def outcome(self):
        return tiny_untrained.evaluated()

    def written(self, out, outcome):
        report.write_results(out, outcome, {"seed": 0}, {"evaluate": 1.5, "total": 2.0})

        def refuse(name):
            raise AssertionError(f"{name} is no JSON")

        return json.loads((out / "metrics.json").read_text(), parse_constant=refuse)

    def test_metrics_json_has_exactly_these_keys_and_the_report_the_best_floor(self, outcome, tmp_path):
        metrics = self.written(tmp_path, outcome)
        keys = "methods paper_minus seconds preset steps seed hardware settings"
        assert set(metrics) == set(keys.split())
        assert set(metrics["methods"]) == {"paper", "white", "splat", "nearest"}
        assert all(set(values) == NUMBERS for values in metrics["methods"].values())
        assert (metrics["preset"], metrics["steps"], metrics["seed"]) == ("tiny", 0, 0)
        assert metrics["seconds"] == {"evaluate": 1.5, "total": 2.0}
        page = (tmp_path / "report.html").read_text()
        assert all(name in page for name in tiny_dataset.SPLITS["test"])
        best = max(("white", "splat", "nearest"), key=lambda name: metrics["methods"][name]["psnr"])
        found = metrics["paper_minus"][best]["psnr"]
        assert found["interval"] is None  # of three objects
        assert f"{found['mean']:+.2f} dB against the best trivial renderer ({best})" in page

    def test_what_does_not_exist_is_null_and_what_is_not_finite_is_refused(self, outcome, tmp_path):
        rows = {name: row | {"cpsnr": None, "cpsnr_views": 0} for name, row in outcome.summary["methods"].items()}
        metrics = self.written(tmp_path, dataclasses.replace(outcome, summary=outcome.summary | {"methods": rows}))
        assert metrics["methods"]["paper"]["cpsnr"] is None
        assert ">nan" not in (tmp_path / "report.html").read_text().lower()
        broken = dataclasses.replace(outcome, summary=outcome.summary | {"steps": float("nan")})
        with pytest.raises(ValueError, match="not JSON compliant"):
            self.written(tmp_path / "new", broken)
        assert not (tmp_path / "new" / "metrics.json").exists()

    def test_an_object_is_shown_in_the_view_of_the_median_psnr(self, outcome, tmp_path):
        result = outcome.gallery[0]
        scores = result.scores | {"paper": result.scores["paper"] | {"psnr": np.array([30.0, 10.0, 20.0])}}
        page = write(tmp_path, gallery=[dataclasses.replace(result, scores=scores)])
        for shown, views in ((0, result.reference), (1, result.pictures["paper"].image)):
            np.testing.assert_allclose(page.pictures[shown] / 255, views[2], atol=0.51 / 255)
