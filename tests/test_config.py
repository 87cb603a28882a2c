"""Configs: every wrong number is an error that names its field, and the presets are what the paper says."""

import dataclasses
import json

import pytest

from spnr_jax.baselines.sizes import NPBGConfig, PointNeRFConfig, Points2NeRFConfig
from spnr_jax.config import LossConfig, OptimizerConfig, TrainConfig
from spnr_jax.formats.config_json import BASELINES, OURS, from_dict, to_dict
from spnr_jax.model_config import EncoderConfig, NearPointsConfig, PaperConfig, SamplingConfig
from spnr_jax.presets import PRESETS, tiny
from spnr_jax.training.trainer import Schedule


@pytest.mark.parametrize(
    ("kind", "field", "value", "hint"),
    [
        (SamplingConfig, "num_coarse", 0, "at least 1"),
        (SamplingConfig, "num_fine", -1, "at least 0"),
        (SamplingConfig, "padding", 0.0, "positive"),
        (EncoderConfig, "volume_resolution", 48, "multiple of 32"),
        (EncoderConfig, "volume_resolution", 0, "multiple of 32"),
        (EncoderConfig, "base_width", 12, "num_groups 8"),
        (PaperConfig, "num_features", 2, "RGB"),
        (EncoderConfig, "materials", ("roughness", "roughness"), "distinct"),
        (PaperConfig, "image_resolution", 100, "resize_resolution"),
        (LossConfig, "l1_weight", -1.0, "at least 0"),
        (LossConfig, "adversarial_weight", -0.1, "at least 0"),
        (LossConfig, "adversarial_start", 1.5, "share"),
        (LossConfig, "r1_interval", 0, "at least 1"),
        (OptimizerConfig, "lr_generator", 0.0, "positive"),
        (OptimizerConfig, "lr_discriminator", -1e-3, "positive"),
        (OptimizerConfig, "ema_decay", 1.0, "[0, 1)"),
        (OptimizerConfig, "warmup_steps", -1, "at least 0"),
        (TrainConfig, "num_steps", 0, "at least 1"),
        (TrainConfig, "batch_objects", 0, "at least 1"),
        (TrainConfig, "min_points", 5000, "max_points 4096"),
        (TrainConfig, "pixel_stride", 0, "at least 1"),
        (TrainConfig, "even_share", 1.1, "a share"),
        (TrainConfig, "pixel_stride", 2, "neighbours"),
        (SamplingConfig, "reach", -1, "at least 0"),
        (NearPointsConfig, "num_neighbors", 0, "at least 1"),
        (NPBGConfig, "encoder_widths", (16,), "one entry more"),
        (NPBGConfig, "encoder_widths", (16, 6, 48, 64, 80), "6 channels of a raster"),
        (NPBGConfig, "near", 0.0, "positive"),
        (NPBGConfig, "image_resolution", 31, "at least 32"),
        (PointNeRFConfig, "radius", 0.0, "positive"),
        (PointNeRFConfig, "num_neighbors", 0, "at least 1"),
        (PointNeRFConfig, "num_samples", 401, "num_candidates 400"),
        (PointNeRFConfig, "density_scale", 0.0, "positive"),
        (PointNeRFConfig, "jitter", 1.5, "a share"),
        (PointNeRFConfig, "ray_chunk", 0, "at least 1"),
        (Points2NeRFConfig, "nerf_depth", 3, "even"),
        (Points2NeRFConfig, "kl_weight", -1.0, "at least 0"),
        (Points2NeRFConfig, "materials", ("base_color", "base_color"), "distinct"),
        (Schedule, "log_every", 0, "at least 1"),
        (Schedule, "preview_every", 0, "at least 1"),
        (Schedule, "checkpoint_every", 0, "at least 1"),
    ],
)
def test_a_wrong_number_names_the_field_what_came_and_what_is_possible(kind, field, value, hint):
    with pytest.raises(ValueError, match=field) as error:
        kind(**{field: value})
    assert hint in str(error.value)
    assert str(value) in str(error.value)


@pytest.mark.parametrize(
    ("kind", "field", "known"),
    [
        (LossConfig, "pixel", "l1 or mse"),
        (LossConfig, "condition", "true or false"),
        (OptimizerConfig, "algorithm", "radam"),
        (OptimizerConfig, "decay", "cosine"),
        (EncoderConfig, "scatter", "mean, max or trilinear"),
        (EncoderConfig, "skip", "add or concat"),
        (PaperConfig, "sees_direction", "true or false"),
    ],
)
def test_an_unknown_word_names_the_known_ones(kind, field, known):
    config = kind()
    object.__setattr__(config, field, "none")  # the tests' type checker would be quicker than the config
    with pytest.raises(ValueError, match=rf"{field} must be .*{known}.*got none"):
        config.__post_init__()


def test_a_pointnet_of_very_many_layers_is_refused():
    with pytest.raises(ValueError, match="point_widths must be at most 32 layers, got"):
        EncoderConfig(point_widths=(4,) * 33)


def test_an_unknown_material_names_the_known_ones():
    config = EncoderConfig()
    object.__setattr__(config, "materials", ("colour",))  # the tests' type checker would be quicker than the config
    with pytest.raises(ValueError, match=r"materials.*base_color.*colour"):
        config.__post_init__()


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
class TestPresets:
    def test_is_named_as_it_is_called_and_says_how_to_run_it(self, preset):
        assert PRESETS[preset().preset] is preset
        assert f"--preset {preset.__name__}" in preset.__doc__

    def test_survives_json(self, preset):
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


class TestFromDict:
    def test_an_unknown_field_is_named_with_its_path(self):
        values = to_dict(TrainConfig())
        values["model"]["sampling"]["num_corse"] = 3
        with pytest.raises(ValueError, match=r"model\.sampling\.num_corse.*num_coarse"):
            from_dict(values)

    def test_a_missing_field_is_named_with_its_path(self):
        values = to_dict(TrainConfig())
        del values["loss"]["r1_gamma"]
        with pytest.raises(ValueError, match=r"loss\.r1_gamma is missing"):
            from_dict(values)

    def test_a_wrong_number_from_a_file_is_refused_too(self):
        values = to_dict(TrainConfig())
        values["model"]["encoder"]["volume_resolution"] = 33
        with pytest.raises(ValueError, match="volume_resolution"):
            from_dict(values)


class TestMethods:
    def test_a_file_names_its_method_and_the_fields_are_those_of_that_method(self):
        names = "surfels", "plus_tiny", "tiny", "npbg_tiny", "point_nerf_tiny", "points2nerf_tiny"
        methods = [to_dict(PRESETS[name]())["model"]["method"] for name in names]
        assert methods == [*OURS, *BASELINES]
        values = to_dict(PRESETS["npbg_tiny"]())
        values["model"]["radius"] = 0.1
        with pytest.raises(ValueError, match=r"unknown config field model\.radius.*encoder_widths"):
            from_dict(values)

    def test_an_unknown_method_names_the_known_ones(self):
        values = to_dict(TrainConfig())
        values["model"]["method"] = "nerf"
        with pytest.raises(ValueError, match=r"model\.method nerf is not one of surfels, near_points, paper, npbg"):
            from_dict(values)

    def test_a_file_that_names_no_method_is_refused(self):
        values = to_dict(PRESETS["abo"]())
        del values["model"]["method"]
        with pytest.raises(ValueError, match=r"model\.method None is not one of"):
            from_dict(values)

    @pytest.mark.parametrize("name", [name for name in PRESETS if isinstance(PRESETS[name]().model, NPBGConfig)])
    def test_the_discriminator_judges_no_baseline(self, name):
        with pytest.raises(ValueError, match="adversarial_weight 1.0.*use 0"):
            dataclasses.replace(PRESETS[name](), loss=LossConfig())

    def test_a_lattice_is_for_independent_pixels_that_it_divides(self):
        quiet = LossConfig(adversarial_weight=0.0)
        assert TrainConfig(model=PointNeRFConfig(image_resolution=200), loss=quiet, pixel_stride=5).pixel_stride == 5
        for model in (NPBGConfig(), PointNeRFConfig(image_resolution=126)):
            with pytest.raises(ValueError, match="pixel_stride 4 needs"):
                TrainConfig(model=model, loss=quiet, pixel_stride=4)


def test_an_image_too_small_for_the_discriminator_is_named():
    small = PaperConfig(render_resolution=8, resize_resolution=8, image_resolution=16)
    with pytest.raises(ValueError, match="image_resolution 16 is too small"):
        TrainConfig(model=small)
    assert TrainConfig(model=small, loss=LossConfig(adversarial_weight=0.0)).model is small


@pytest.mark.parametrize(
    "change",
    [
        {"field_width": True}, {"field_width": 16.0}, {"sees_direction": 1}, {"precision": None}, {"sampling": 3},
        {"image_resolution": -64}, {"encoder": None},
    ],
)  # fmt: skip
def test_a_stored_value_of_another_type_or_size_is_refused(change):
    values = json.loads(json.dumps(to_dict(tiny())))
    with pytest.raises(ValueError, match=next(iter(change))):
        from_dict(values | {"model": values["model"] | change})


@pytest.mark.parametrize(
    "change",
    [
        {"num_stages": 2**62}, {"num_stages": 10**400}, {"num_groups": 0}, {"base_width": 16.0}, {"materials": [["a"]]},
        {"point_widths": 8},
    ],
)  # fmt: skip
def test_so_is_one_of_the_encoder(change):
    values = json.loads(json.dumps(to_dict(tiny())))
    encoder = {"encoder": values["model"]["encoder"] | change}
    with pytest.raises(ValueError, match=next(iter(change))):
        from_dict(values | {"model": values["model"] | encoder})


def test_a_number_that_is_not_finite_is_refused():
    for number in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="mse_weight must be a number, got"):
            LossConfig(mse_weight=number)
