"""Configs: every wrong number is an error that names its field, and the presets are what the paper says."""

import dataclasses
import json

import pytest

from spnr_jax.config import LossConfig, OptimizerConfig, TrainConfig, from_dict, to_dict
from spnr_jax.model_config import METHODS, ModelConfig, NPBGConfig, PointNeRFConfig, SamplingConfig
from spnr_jax.presets import PRESETS, tiny


@pytest.mark.parametrize(
    ("kind", "field", "value", "hint"),
    [
        (SamplingConfig, "num_coarse", 0, "at least 1"),
        (SamplingConfig, "num_fine", -1, "at least 0"),
        (SamplingConfig, "padding", 0.0, "positive"),
        (ModelConfig, "volume_resolution", 48, "multiple of 32"),
        (ModelConfig, "volume_resolution", 0, "multiple of 32"),
        (ModelConfig, "base_width", 12, "num_groups 8"),
        (ModelConfig, "num_features", 2, "RGB"),
        (ModelConfig, "materials", ("roughness", "roughness"), "distinct"),
        (ModelConfig, "image_resolution", 100, "resize_resolution"),
        (LossConfig, "l1_weight", -1.0, "negative"),
        (LossConfig, "adversarial_weight", -0.1, "negative"),
        (LossConfig, "adversarial_start", 1.5, "share"),
        (LossConfig, "r1_interval", 0, "at least 1"),
        (OptimizerConfig, "lr_generator", 0.0, "positive"),
        (OptimizerConfig, "lr_discriminator", -1e-3, "positive"),
        (OptimizerConfig, "ema_decay", 1.0, "[0, 1)"),
        (OptimizerConfig, "warmup_steps", -1, "negative"),
        (TrainConfig, "num_steps", 0, "at least 1"),
        (TrainConfig, "batch_objects", 0, "at least 1"),
        (TrainConfig, "min_points", 5000, "max_points 4096"),
        (TrainConfig, "pixel_stride", 0, "at least 1"),
        (TrainConfig, "even_share", 1.1, "a share"),
        (TrainConfig, "pixel_stride", 2, "neighbours"),
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
        (ModelConfig, "scatter", "mean, max or trilinear"),
        (ModelConfig, "skip", "add or concat"),
        (ModelConfig, "sees_direction", "true or false"),
    ],
)
def test_an_unknown_word_names_the_known_ones(kind, field, known):
    config = kind()
    object.__setattr__(config, field, "none")  # the tests' type checker would be quicker than the config
    with pytest.raises(ValueError, match=rf"{field} must be .*{known}.*got none"):
        config.__post_init__()


def test_a_pointnet_of_very_many_layers_is_refused():
    with pytest.raises(ValueError, match="point_widths must name at most 32 layers, got 33"):
        ModelConfig(point_widths=(4,) * 33)


def test_an_unknown_material_names_the_known_ones():
    config = ModelConfig()
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

    def test_is_hashable_so_that_it_can_be_static(self, preset):
        assert hash(preset()) == hash(preset())


@pytest.mark.parametrize("name", ["abo", "shapenet_car", "shapenet_plane", "shapenet_chair"])
def test_paper_presets_have_the_papers_sizes(name):
    config = PRESETS[name]()
    model, counts = config.model, config.model.sampling
    assert (model.point_widths, model.num_stages, model.render_resolution) == ((64, 128, 256), 5, 64)
    assert (counts.num_coarse, counts.num_fine) == (64, 64)
    sizes = (model.resize_resolution, model.image_resolution)
    assert sizes == ((64, 128) if name == "abo" else (100, 200))
    assert config.loss.l1_weight == (5000 if name == "shapenet_chair" else 100)
    assert config.loss.adversarial_weight == 1


def test_a_larger_volume_and_a_wider_network_are_only_numbers():
    config = dataclasses.replace(PRESETS["abo"](), model=ModelConfig(volume_resolution=128, base_width=32))
    assert (config.model.volume_resolution, config.model.base_width) == (128, 32)


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
        values["model"]["volume_resolution"] = 33
        with pytest.raises(ValueError, match="volume_resolution"):
            from_dict(values)


class TestMethods:
    def test_a_file_names_its_method_and_the_fields_are_those_of_that_method(self):
        names = "tiny", "surfels", "npbg_tiny", "point_nerf_tiny", "points2nerf_tiny"
        methods = [to_dict(PRESETS[name]())["model"]["method"] for name in names]
        assert methods == list(METHODS)
        values = to_dict(PRESETS["npbg_tiny"]())
        values["model"]["radius"] = 0.1
        with pytest.raises(ValueError, match=r"unknown config field model\.radius.*encoder_widths"):
            from_dict(values)

    def test_an_unknown_method_names_the_known_ones(self):
        values = to_dict(TrainConfig())
        values["model"]["method"] = "nerf"
        with pytest.raises(ValueError, match=r"model\.method nerf is not one of ours, surfels, npbg"):
            from_dict(values)

    def test_a_file_from_before_there_were_baselines_is_read_as_ours(self):
        values = to_dict(PRESETS["abo"]())
        del values["model"]["method"], values["pixel_stride"]
        del values["loss"]["pixel"], values["loss"]["masked"]
        del values["optimizer"]["algorithm"], values["optimizer"]["decay"]
        del values["loss"]["condition"]
        del values["model"]["scatter"], values["model"]["skip"], values["model"]["sees_direction"]
        assert from_dict(values) == PRESETS["abo"]()

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


def test_unknown_options_are_errors():
    with pytest.raises(TypeError, match="num_samples"):
        SamplingConfig(num_samples=3)


def test_material_channels_are_counted_from_the_names():
    assert ModelConfig().num_material_channels == 5
    assert ModelConfig(materials=("roughness",)).num_material_channels == 1
    assert ModelConfig(materials=()).num_material_channels == 0


def test_an_image_too_small_for_the_discriminator_is_named():
    small = ModelConfig(render_resolution=8, resize_resolution=8, image_resolution=16)
    with pytest.raises(ValueError, match="image_resolution 16 is too small"):
        TrainConfig(model=small)
    assert TrainConfig(model=small, loss=LossConfig(adversarial_weight=0.0)).model is small


@pytest.mark.parametrize(
    "change",
    [
        {"num_stages": 2**62}, {"num_stages": 10**400}, {"num_groups": 0}, {"base_width": 16.0}, {"materials": [["a"]]},
        {"sees_direction": 1}, {"precision": None}, {"point_widths": 8}, {"field_width": True},
        {"sampling": 3}, {"image_resolution": -64},
    ],
)  # fmt: skip
def test_a_stored_value_of_another_type_or_size_is_refused(change):
    values = json.loads(json.dumps(to_dict(tiny())))
    with pytest.raises(ValueError, match=next(iter(change))):
        from_dict(values | {"model": values["model"] | change})
