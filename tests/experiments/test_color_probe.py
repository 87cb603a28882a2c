"""The colour probe: what a linear map tells of colours, and how far the hue of pictures follows."""

import dataclasses

import numpy as np
import pytest
from support import tiny_dataset
from support.tiny_runs import shrunken

from experiments.comparison.object_scores import mean_colors
from experiments.comparison.trained_networks import Network
from experiments.studies import color_probe
from spnr_jax import presets
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.scoring.evaluation import Pictures
from spnr_jax.training import optimisation

RNG = np.random.default_rng(0)


def network(config, show=None):
    state = optimisation.jitted_create_state(config)
    made = Network(
        method=config.model.method,
        config=config,
        variables=optimisation.averaged_variables(state),
        steps=0,
        checksum="",
    )
    if show:
        object.__setattr__(made, "show", lambda: show)
    return made


def test_a_linear_map_is_told_whole_and_noise_not_at_all():
    features, others = RNG.normal(size=(2, 400, 6))
    matrix = RNG.normal(size=(6, 3))
    told = color_probe.told(features, 3 + features @ matrix, others, 3 + others @ matrix)
    np.testing.assert_allclose(told, 1, atol=1e-4)
    told = color_probe.told(features, RNG.normal(size=(400, 3)), others, RNG.normal(size=(400, 3)))
    assert (np.abs(told) < 0.1).all()


def test_the_hue_of_the_references_is_followed_and_that_of_half_as_colourful_ones_by_half():
    dataset = tiny_dataset.dataset()
    items = {name: data_sets.read_object(dataset, name) for name in dataset.splits["test"]}
    white = {name: data_sets.on_white(item.images) for name, item in items.items()}
    order = iter([*white.values()] * 2)

    def shown(_, camera, strength):
        image = next(order)
        grey = image.mean(axis=-1, keepdims=True)
        return Pictures(image=grey + strength * (image - grey), acc=image[..., 0])

    with shrunken():
        config = presets.PRESETS["tiny"]()
    for strength in (1.0, 0.5):
        method = network(config, lambda cloud, camera, s=strength: shown(cloud, camera, s))
        assert color_probe.hue_followed(method, dataset) == pytest.approx((strength, 1.0), abs=1e-5)
    colors = mean_colors(next(iter(items.values())), next(iter(white.values())))
    assert colors.shape == (tiny_dataset.VIEWS, 3)


def test_an_untrained_network_is_probed_in_every_layer_and_others_are_refused(tmp_path):
    dataset = tiny_dataset.dataset()
    options = color_probe.ColorProbe(data=dataset.folder, out=tmp_path, runs=(tmp_path,), objects=2)
    with shrunken():
        config = presets.PRESETS["tiny"]()
    found = color_probe.probed(network(config), dataset, options)
    assert set(found["layers"]) == {"points", "stem", "volume"}
    assert all(np.isfinite(values).all() and max(values) <= 1 for values in found["layers"].values())
    with pytest.raises(UserError, match="no volume"):
        color_probe.probed(
            dataclasses.replace(network(config), config=presets.PRESETS["npbg_tiny"]()), dataset, options
        )
    with pytest.raises(UserError, match="objects"):
        dataclasses.replace(options, objects=0)
