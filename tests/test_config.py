"""Configs: a wrong number is an error that names its field and what came, and the presets are what the paper says."""

import json
from dataclasses import replace

import pytest

from spnr_jax.config import (
    EncoderConfig,
    LossConfig,
    OptimizerConfig,
    PaperConfig,
    SamplingConfig,
    Schedule,
    TrainConfig,
)
from spnr_jax.methods import from_dict, to_dict
from spnr_jax.presets import PRESETS, surfels, tiny


@pytest.mark.parametrize(
    ("kind", "field", "value", "hint"),
    [
        (SamplingConfig, "num_coarse", 0, "above 0"),
        (SamplingConfig, "num_fine", -1, "at least 0"),
        (SamplingConfig, "padding", 0.0, "above 0"),
        (EncoderConfig, "volume_resolution", 48, "multiple of 32"),
        (EncoderConfig, "base_width", 12, "num_groups 8"),
        (EncoderConfig, "point_widths", (8, 0), "above 0"),
        (EncoderConfig, "point_widths", (4,) * 33, "at most 32"),
        (EncoderConfig, "num_stages", 17, "at most 16"),
        (EncoderConfig, "materials", ("roughness", "roughness"), "distinct"),
        (PaperConfig, "field_width", 0, "above 0"),
        (PaperConfig, "num_features", 2, "RGB"),
        (PaperConfig, "image_resolution", 100, "resize_resolution"),
        (LossConfig, "l1_weight", -1.0, "at least 0"),
        (LossConfig, "mse_weight", float("nan"), "a number"),
        (LossConfig, "mse_weight", float("inf"), "a number"),
        (LossConfig, "adversarial_start", 1.5, "share"),
        (OptimizerConfig, "lr_generator", 0.0, "above 0"),
        (OptimizerConfig, "ema_decay", 1.0, "below 1"),
        (OptimizerConfig, "warmup_steps", -1, "at least 0"),
        (TrainConfig, "num_steps", 0, "above 0"),
        (TrainConfig, "num_steps", -3, "a whole number, above 0"),
        (TrainConfig, "min_points", 5000, "max_points 4096"),
        (TrainConfig, "even_share", 1.1, "a share"),
        (Schedule, "log_every", 0, "above 0"),
    ],
)
def test_a_wrong_number_names_the_field_what_came_and_what_is_possible(kind, field, value, hint):
    with pytest.raises(ValueError, match=field) as error:
        kind(**{field: value})
    assert hint in str(error.value)
    assert str(value) in str(error.value)


@pytest.mark.parametrize(
    ("preset", "crop", "hint"), [(surfels, 0, "of 16 to 512"), (surfels, 513, "512"), (tiny, 48, "use 0")]
)
def test_crops_suit_the_network(preset, crop, hint):
    with pytest.raises(ValueError, match=f"crop {crop}: .*{hint}"):
        replace(preset(), crop=crop)


OWN = [name for name in PRESETS if PRESETS[name].__module__ == "spnr_jax.presets"]  # other tests add to them


@pytest.mark.parametrize("preset", [PRESETS[name] for name in OWN], ids=OWN)
def test_a_preset_is_named_as_it_is_called_says_how_to_run_it_and_survives_json(preset):
    assert PRESETS[preset().preset] is preset
    assert f"--preset {preset.__name__}" in preset.__doc__
    assert from_dict(json.loads(json.dumps(to_dict(preset())))) == preset()


@pytest.mark.parametrize("name", ["abo", "shapenet_car", "shapenet_plane", "shapenet_chair"])
def test_paper_presets_have_the_papers_sizes(name):
    config = PRESETS[name]()
    model, counts = config.model, config.model.sampling
    assert (model.encoder.point_widths, model.encoder.num_stages, model.render_resolution) == ((64, 128, 256), 5, 64)
    assert (counts.num_coarse, counts.num_fine) == (64, 64)
    sizes = (model.resize_resolution, model.image_resolution)
    assert sizes == ((64, 128) if name == "abo" else (100, 200))
    assert config.loss.l1_weight == (5000 if name == "shapenet_chair" else 100)
    assert config.loss.adversarial_weight == 1


def test_an_image_too_small_for_the_discriminator_is_named():
    small = PaperConfig(render_resolution=8, resize_resolution=8, image_resolution=16)
    with pytest.raises(ValueError, match="image_resolution 16 is too small"):
        TrainConfig(model=small)
    assert TrainConfig(model=small, loss=LossConfig(adversarial_weight=0.0)).model is small


class TestOfAFile:
    @pytest.mark.parametrize(
        ("part", "change", "reason"),
        [
            ("sampling", {"num_corse": 3}, r"unknown config field model\.sampling\.num_corse.*num_coarse"),
            ("encoder", {"volume_resolution": 33}, "volume_resolution"),
            ("encoder", {"num_stages": 10**400}, "num_stages"),
            ("encoder", {"num_groups": 0}, "num_groups"),
            ("encoder", {"base_width": 16.0}, "base_width must be a whole number"),
            ("encoder", {"materials": [["a"]]}, "materials must be base_color, roughness or metallic"),
            ("encoder", {"point_widths": 8}, "point_widths must be several values"),
            ("encoder", {"inputs": "none"}, "inputs must be plain or spread, got 'none'"),
            (None, {"field_width": True}, "field_width"),
            (None, {"sees_direction": 1}, "sees_direction must be true or false"),
            (None, {"precision": None}, "precision"),
            (None, {"image_resolution": -64}, "image_resolution"),
            (None, {"sampling": 3}, r"model\.sampling holds 3"),
            (None, {"radius": 0.1}, r"unknown config field model\.radius"),
            (None, {"method": "nerf"}, r"model\.method nerf is not one of surfels, paper"),
            (None, {"method": ["paper"]}, r"model\.method .* is not one of"),
        ],
    )
    def test_what_is_wrong_is_refused_by_name(self, part, change, reason):
        values = json.loads(json.dumps(to_dict(tiny())))
        changed = values["model"] if part is None else values["model"][part]
        changed |= change
        with pytest.raises(ValueError, match=reason):
            from_dict(values)

    def test_what_is_missing_is_named_with_its_path(self):
        values = to_dict(TrainConfig())
        del values["loss"]["r1_gamma"]
        with pytest.raises(ValueError, match=r"loss\.r1_gamma is missing"):
            from_dict(values)


@pytest.mark.parametrize(("pixel", "weights"), [("l1", (3.0, 0.5)), ("mse", (0.0, 3.0))])
def test_a_file_from_before_squared_errors_had_one_weight_means_what_it_did(pixel, weights):
    values = to_dict(replace(tiny(), loss=LossConfig(l1_weight=3.0, mse_weight=0.5)))
    values["loss"]["pixel"] = pixel
    loss = from_dict(values).loss
    assert (loss.l1_weight, loss.mse_weight) == weights
