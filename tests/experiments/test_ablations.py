"""Ablations: each row changes one thing; a stopped experiment goes on to the same numbers; differences are paired."""

import dataclasses
import json

import numpy as np
import pytest
from support import tiny_dataset
from support.tiny_runs import check_conditions, results_of, shrunken

from experiments.comparison import variants, variants_report
from experiments.comparison.variants import Budget, Compared
from experiments.studies.ablations import LABELS, ROWS, Ablations, changed, folds, main, rows
from spnr_jax import presets
from spnr_jax.config import RayNetworkConfig
from spnr_jax.formats import data_sets
from spnr_jax.formats.config_json import to_dict
from spnr_jax.scoring import evaluation, summary
from spnr_jax.training import checkpoint, optimisation

pytestmark = pytest.mark.ci  # it trains several networks
PLUS_ROWS = ("free_colour", "no_neighbours", "three_neighbours", "twelve_neighbours", "batch_norm")
PLUS_ROWS += ("no_opacity_loss", "no_squared_error", "view_direction")


@pytest.fixture(scope="module", autouse=True)
def _shrunken():
    with shrunken():
        yield


def asked(out, wanted=("plain_inputs",), dataset=None, folds=1, **budget):
    folder = dataset or tiny_dataset.dataset().folder
    return Ablations(data=folder, out=out, rows=wanted, folds=folds, budget=Budget(**{"quick": True} | budget))


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ablations") / "out"
    main(asked(folder))
    return folder


def leaves(values, path=""):
    for name, value in values.items():
        yield from leaves(value, f"{path}{name}.") if isinstance(value, dict) else [(f"{path}{name}", value)]


class TestRows:
    tiny = presets.tiny()

    def test_each_changes_what_it_says_and_nothing_else(self):
        expected = {
            "paper": {},  # the preset itself
            "no_condition": {"loss.condition": False},
            "no_colour_variants": {},
            "depth_3": {},  # tiny's own
            "depth_4": {"model.encoder.num_stages": 4},
            "depth_5": {"model.encoder.num_stages": 5},
            "no_fine_samples": {"model.sampling.num_coarse": 32, "model.sampling.num_fine": 0},
            "no_view_direction": {"model.sees_direction": False},
            "plain_inputs": {"model.encoder.inputs": "plain"},
            "fewer_channels": {"model.encoder.base_width": 8},
            "adversarial": {},  # tiny has it
            "no_average": {"optimizer.ema_decay": 0.0},
            "one_count": {"min_points": 1024},
            "more_views": {"views_per_object": 4},
            "half_samples": {"model.sampling.num_coarse": 8, "model.sampling.num_fine": 8},
            "twice_samples": {"model.sampling.num_coarse": 32, "model.sampling.num_fine": 32},
        } | dict.fromkeys(PLUS_ROWS, {})
        assert {row: self.changes(row, self.tiny) for row in ROWS} == expected
        assert set(LABELS) == set(ROWS)

    def test_what_makes_a_plus_network_is_taken_away_piece_by_piece(self):
        expected = {
            "free_colour": {"model.color": "free"},
            "three_neighbours": {"model.num_neighbors": 3},
            "twelve_neighbours": {"model.num_neighbors": 12},
            "batch_norm": {"model.encoder.point_norm": "batch"},
            "no_opacity_loss": {"loss.opacity_weight": 0.0},
            "no_squared_error": {"loss.mse_weight": 0.0},
            "view_direction": {"model.sees_direction": True},
        }
        changed_rows = {row: self.changes(row, presets.plus_tiny()) for row in PLUS_ROWS if row != "no_neighbours"}
        assert changed_rows == expected

    def test_without_neighbours_it_is_the_paper_s_field_near_the_points(self):
        near, paper = (changed(row, presets.plus_tiny()).model for row in ("free_colour", "no_neighbours"))
        assert (paper.method, paper.num_features, paper.upsamples) == ("paper", 32, False)
        for field in dataclasses.fields(RayNetworkConfig):
            assert getattr(paper, field.name) == getattr(near, field.name)

    def test_the_paper_s_network_is_the_preset_that_a_plus_one_was_made_of(self):
        plus = dataclasses.replace(presets.plus_tiny(), num_steps=77)
        assert changed("paper", plus) == dataclasses.replace(presets.tiny(), num_steps=77)
        model, larger = changed("paper", presets.plus_small()).model, presets.plus_small().model
        tiny = presets.tiny().model
        assert (model.image_resolution, model.method) == (128, "paper")
        assert model.field_width == larger.field_width
        assert model == dataclasses.replace(
            tiny, render_resolution=64, resize_resolution=64, image_resolution=larger.image_resolution
        )
        assert changed("paper", presets.tiny()) == presets.tiny()

    @staticmethod
    def changes(row, config):
        before = dict(leaves(to_dict(config)))
        return {name: value for name, value in leaves(to_dict(changed(row, config))) if before[name] != value}

    def test_without_colour_variants_the_training_split_alone_shrinks(self):
        splits = tiny_dataset.SPLITS | {"train": ("a", "a--1", "a--2", "b")}
        dataset = dataclasses.replace(tiny_dataset.dataset(), splits=splits)
        (_, variant) = rows(("no_colour_variants",), self.tiny, dataset)
        assert variant.dataset.splits == tiny_dataset.SPLITS | {"train": ("a", "b")}
        assert variant.config == self.tiny


def test_scores_and_differences_are_those_of_the_runs_on_the_same_views(out):
    results, psnr = results_of(out), {}
    for row in ("reference", "plain_inputs"):
        found, state = checkpoint.load_run(out / "runs" / f"{row}_0")
        show = {row: evaluation.network(optimisation.averaged_variables(state), found)}
        scored = evaluation.evaluate_objects(show, found, tiny_dataset.dataset(), ("ball_000004", "chair"))
        own = {result.name: result.scores[row]["psnr"] for result in scored}
        psnr[row] = np.concatenate(list(own.values()))
        assert results["variants"][row]["psnr"] == pytest.approx(psnr[row].mean(), abs=1e-5)
        for origin, name in (("procedural", "ball_000004"), ("mesh files", "chair")):
            part = results["by_origin"][origin]
            assert part["test_objects"] == [name]
            assert part["variants"][row]["psnr"] == pytest.approx(own[name].mean(), abs=1e-5)
            assert results["by_object"][name][row]["psnr"] == pytest.approx(own[name].mean(), abs=1e-4)
    difference = results["minus_reference"]["plain_inputs"]["psnr"]
    assert difference["mean"] == pytest.approx((psnr["plain_inputs"] - psnr["reference"]).mean(), abs=1e-5)
    assert difference["by_seed"] == [difference["mean"]]
    assert results["test_objects"] == ["ball_000004", "chair"]
    check_conditions(out)


def test_every_object_is_scored_once_by_networks_that_never_saw_it(tmp_path):
    main(asked(tmp_path, folds=3, quick=False, steps=2))
    names = {name for split in tiny_dataset.SPLITS.values() for name in split}
    results = results_of(tmp_path)
    assert sorted(results["test_objects"]) == sorted(names)
    for number, part in enumerate(folds(tiny_dataset.dataset(), 3)):
        assert set(part.splits["test"]) | set(part.splits["train"]) == names
        assert not set(part.splits["test"]) & set(part.splits["train"])
        assert (tmp_path / f"fold_{number}" / "runs" / "reference_0" / "config.json").is_file()
    psnr = []
    for number, part in enumerate(folds(tiny_dataset.dataset(), 3)):
        found, state = checkpoint.load_run(tmp_path / f"fold_{number}" / "runs" / "reference_0")
        show = {"shown": evaluation.network(optimisation.averaged_variables(state), found)}
        scored = evaluation.evaluate_objects(show, found, part, part.splits["test"])
        psnr += [result.scores["shown"]["psnr"] for result in scored]
    assert results["variants"]["reference"]["psnr"] == pytest.approx(np.mean(np.concatenate(psnr)), abs=1e-5)


def test_variants_are_held_out_with_their_object():
    splits = {"train": ("a", "a--1", "b", "c"), "val": (), "test": ("d",)}
    dataset = dataclasses.replace(tiny_dataset.dataset(), splits=splits)
    first, second = folds(dataset, 2)
    assert first.splits == {"train": ("b", "d"), "val": (), "test": ("a", "c")}
    assert second.splits == {"train": ("a", "a--1", "c"), "val": (), "test": ("b", "d")}
    with pytest.raises(ValueError, match="--folds 3.*holds 4 objects, too few"):
        folds(dataset, 3)


class TestReport:
    """Two variants, two seeds, three objects of two views with made-up scores."""

    rng = np.random.default_rng(0)
    by_seed = {
        name: [
            [{metric: level + seed + rng.random(2) for metric in variants_report.METRICS} for _ in range(3)]
            for seed in range(2)
        ]
        for name, level, rng in (("a", 10.0, rng), ("b", 13.0, rng))
    }
    compared = Compared(
        names=("one", "two", "three"),
        scores={n: [variants.joined(o) for o in zip(*seeds, strict=True)] for n, seeds in by_seed.items()},
        by_seed=by_seed,
        costs={},
        shown=[],
        shown_scores=[],
    )

    def test_a_difference_compares_equal_seeds_objects_and_views(self):
        found = variants_report.change(self.compared, "b", "a", "psnr")
        pairs = zip(self.by_seed["b"], self.by_seed["a"], strict=True)
        means = [
            np.mean([b["psnr"] - a["psnr"] for b, a in zip(first, second, strict=True)]) for first, second in pairs
        ]
        assert found["by_seed"] == pytest.approx(means)
        assert found["mean"] == pytest.approx(np.mean(means))
        assert found["interval"][0] < found["mean"] < found["interval"][1]

    def test_a_metric_that_no_view_has_is_none(self):
        nothing = [{metric: np.full(2, np.nan) for metric in variants_report.METRICS}] * 3
        assert summary.means(nothing, ["detail"])["detail"] is None
        scores = {"a": nothing, "b": nothing}
        compared = dataclasses.replace(self.compared, scores=scores)
        assert variants_report.change(compared, "b", "a", "detail") is None


def test_the_pace_of_a_run_is_not_that_of_its_compilations(tmp_path):
    paces = (900.0, 10.0, 30.0, 20.0, 20.0, 800.0, 10.0, 20.0, 30.0)
    rows = [{"step": i, "ms_per_step": pace} for i, pace in enumerate(paces)] + [{"step": 9, "val_psnr": 1.0}]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert variants.step_milliseconds(tmp_path) == 20.0
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows[:3]))
    assert variants.step_milliseconds(tmp_path) is None


def test_scores_inside_the_silhouette_do_not_see_the_rest():
    item = data_sets.read_object(tiny_dataset.dataset(), "chair")
    reference = data_sets.on_white(item.images)
    outside = item.images[..., 3:] <= 127
    spoilt = np.where(outside, np.float32(0.5), reference)
    found = variants.more_scores(item, evaluation.Pictures(image=spoilt, acc=spoilt[..., 0]))
    np.testing.assert_allclose(found["inside"], 100.0)
    equal = variants.more_scores(item, evaluation.Pictures(image=reference, acc=reference[..., 0]))
    np.testing.assert_allclose(equal["detail"], 1.0, rtol=1e-5)
