"""What single experiments compute, apart from drawing and training: rows, fronts, classes, views, light."""

import dataclasses

import numpy as np
import pytest
from support import tiny_dataset

from experiments.paper.fig1 import Fig1, variant
from experiments.paper.fig2 import nearest_views
from experiments.studies import point_count, relighting
from experiments.studies.ablations import LABELS, ROWS, changed, folds, rows
from experiments.studies.speed_accuracy import front, knee
from spnr_jax import config, presets
from spnr_jax.methods import to_dict
from spnr_jax.training import optimisation


def leaves(values, path=""):
    for name, value in values.items():
        yield from leaves(value, f"{path}{name}.") if isinstance(value, dict) else [(f"{path}{name}", value)]


class TestRows:
    tiny = presets.tiny()

    def test_each_changes_what_it_says_and_nothing_else(self):
        expected = {
            "no_condition": {"loss.condition": False},
            "no_colour_variants": {},
            "depth_3": {},  # tiny's own
            "depth_4": {"model.encoder.num_stages": 4},
            "depth_5": {"model.encoder.num_stages": 5},
            "no_fine_samples": {"model.sampling.num_coarse": 32, "model.sampling.num_fine": 0},
            "no_view_direction": {"model.sees_direction": False},
            "plain_inputs": {"model.encoder.inputs": "plain"},
            "fewer_channels": {"model.encoder.base_width": 8},
            "no_average": {"optimizer.ema_decay": 0.0},
            "one_count": {"min_points": 1024},
            "more_views": {"views_per_object": 4},
            "half_samples": {"model.sampling.num_coarse": 8, "model.sampling.num_fine": 8},
            "twice_samples": {"model.sampling.num_coarse": 32, "model.sampling.num_fine": 32},
        }
        assert {row: self.changes(row, self.tiny) for row in ROWS} == expected
        assert set(LABELS) == set(ROWS)

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


def test_variants_are_held_out_with_their_object():
    splits = {"train": ("a", "a--1", "b", "c"), "val": (), "test": ("d",)}
    dataset = dataclasses.replace(tiny_dataset.dataset(), splits=splits)
    first, second = folds(dataset, 2)
    assert first.splits == {"train": ("b", "d"), "val": (), "test": ("a", "c")}
    assert second.splits == {"train": ("a", "a--1", "c"), "val": (), "test": ("b", "d")}
    with pytest.raises(ValueError, match="--folds 3.*holds 4 objects, too few"):
        folds(dataset, 3)


def test_the_adversarial_loss_takes_part_from_the_first_step_and_the_weights_alone_differ():
    options = Fig1(data=tiny_dataset.dataset().folder, out=tiny_dataset.folder())
    made = [variant(options, weight, presets.tiny(), tiny_dataset.dataset()) for weight in options.l1_weights]
    assert [v.config.loss.l1_weight for v in made] == [0, 100, 5000]
    for v in made:
        assert (v.config.loss.adversarial_weight, optimisation.first_adversarial_step(v.config)) == (1, 0)
        assert v.start is None
        assert dataclasses.replace(v.config, loss=config.LossConfig()) == dataclasses.replace(
            presets.tiny(), loss=config.LossConfig()
        )


def test_the_nearest_views_look_from_the_same_side():
    angles = np.radians([[0, 90, 180], [95, 200, 300], [270, 10, 88]])
    eyes = [3 * np.stack([np.sin(a), 0 * a, np.cos(a)], axis=-1) for a in angles]
    assert nearest_views(eyes) == [1, 0, 2]


def row(ms, psnr):
    return {"ms_view": ms, "psnr": psnr}


class TestFront:
    rows = (row(4, 20.0), row(2, 18.0), row(8, 21.0), row(5, 19.0), row(3, 20.5), row(3, 20.4), row(16, 21.0))

    def test_it_holds_the_settings_that_no_other_beats_cheapest_first(self):
        assert front(list(self.rows)) == [1, 4, 2]

    def test_its_knee_lies_farthest_above_the_line_from_the_cheapest_to_the_best(self):
        assert knee(list(self.rows), front(list(self.rows))) == 4

    def test_a_single_setting_is_front_and_knee(self):
        assert knee([row(1, 1.0)], front([row(1, 1.0)])) == 0


def test_classes_have_the_means_of_their_objects_and_the_best_method_is_counted():
    objects = {"chair_000001": (20.0, 10.0), "chair_000002": (24.0, 30.0), "sofa_000003": (15.0, 25.0)}
    scores = {
        label: {name: {"psnr": [values[i] - 1, values[i] + 1]} for name, values in objects.items()}
        for i, label in enumerate("ab")
    }
    assert point_count.by_class(scores) == {
        "chair": {"objects": 2, "psnr": {"a": 22.0, "b": 20.0}, "best on": {"a": 1, "b": 1}},
        "sofa": {"objects": 1, "psnr": {"a": 15.0, "b": 25.0}, "best on": {"a": 0, "b": 1}},
    }


def test_scores_of_a_picture_that_is_right_and_of_one_half_as_bright():
    reference = np.ones((32, 32, 4), np.float32)
    reference[..., :3] = 0.6
    right = relighting.scores(reference[..., :3], reference[..., 3], reference)
    assert right == pytest.approx([100.0, 100.0, 0.0, 0.0], abs=1e-3)
    linear = ((0.6 + 0.055) / 1.055) ** 2.4 / 2
    dim = np.full((32, 32, 3), 1.055 * linear ** (1 / 2.4) - 0.055, np.float32)
    assert relighting.scores(dim, reference[..., 3], reference)[3] == pytest.approx(np.log(2), abs=1e-3)
