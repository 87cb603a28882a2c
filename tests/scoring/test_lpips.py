"""LPIPS against the `lpips` package at equal random weights, and its laws."""

import importlib
import importlib.util
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers
from support.tiny_lpips import WEIGHTS, files

from spnr_jax.scoring import lpips_weights
from spnr_jax.scoring.lpips import SMALLEST, LpipsWeights, features, lpips, normalised

IMAGE, REFERENCE = numbers(0, 2, 40, 33, 3, low=0.0), numbers(1, 2, 40, 33, 3, low=0.0)
measure = jax.jit(lpips)


def alexnet_features(torch):
    """The convolutional part of AlexNet, from layers of PyTorch."""
    nn = torch.nn
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2),
    )  # fmt: skip


@pytest.fixture
def torch():
    return pytest.importorskip("torch", reason="needs PyTorch (extra bench)")


@pytest.fixture
def package(torch, monkeypatch):
    """The package `lpips`; it takes AlexNet's layers from torchvision, which stands in here if it is not installed."""
    if importlib.util.find_spec("lpips") is None:
        pytest.skip("needs the package lpips (extra bench)")
    models = types.SimpleNamespace(alexnet=lambda pretrained: types.SimpleNamespace(features=alexnet_features(torch)))
    monkeypatch.setitem(sys.modules, "torchvision", types.SimpleNamespace(models=models))
    yield importlib.import_module("lpips")
    for name in [name for name in sys.modules if name.partition(".")[0] == "lpips"]:
        del sys.modules[name]  # it holds on to the stand-in


@pytest.mark.parametrize("size", [(31, 31), (40, 33), (64, 64)])
def test_is_the_package_at_equal_random_weights(size, torch, package, tmp_path):
    alexnet, heads = files(tmp_path, torch)
    lpips_weights.convert(alexnet, heads, tmp_path / "lpips.npz")
    weights = lpips_weights.read_weights(tmp_path / "lpips.npz")
    twin = package.LPIPS(net="alex", version="0.1", pnet_rand=True, model_path=str(heads), verbose=False)
    state = [tensor for name, tensor in torch.load(alexnet).items() if name.startswith("features")]
    twin.net.load_state_dict(dict(zip(twin.net.state_dict(), state, strict=True)))
    rng = np.random.default_rng(3)
    images = np.float32(rng.random((2, 3, *size, 3)))
    images[0, 2], images[1, 2] = 1, 0
    with torch.no_grad():
        channels_first = (torch.tensor(x.transpose(0, 3, 1, 2).copy()) for x in images)
        expected = twin(*channels_first, normalize=True).numpy().ravel()
    assert (expected > 0.1).all(), "far from 0, or the comparison says nothing"
    close(measure(*images, weights), expected, rtol=0, atol=1e-5)


def test_the_last_features_are_those_of_five_convolutions_on_images_from_minus_one_to_one():
    constant = LpipsWeights(
        kernels=tuple(np.zeros_like(kernel) for kernel in WEIGHTS.kernels),
        biases=tuple(np.full_like(bias, i) for i, bias in enumerate(WEIGHTS.biases)),
        heads=WEIGHTS.heads,
    )
    shapes = [(9, 7, 64), (4, 3, 192), (1, 1, 384), (1, 1, 256), (1, 1, 256)]
    found = features(IMAGE, constant)
    assert [layer.shape[1:] for layer in found] == shapes
    assert [set(np.unique(layer)) for layer in found] == [{float(i)} for i in range(5)]
    first = features(jnp.stack([jnp.zeros((40, 33, 3)), jnp.ones((40, 33, 3))]), WEIGHTS)[0][:, 4, 3]
    for got, value in zip(first, (-1.0, 1.0), strict=True):
        scaled = (value - np.array([-0.030, -0.088, -0.188])) / np.array([0.458, 0.448, 0.450])
        expected = np.einsum("hwio,i->o", WEIGHTS.kernels[0], scaled) + WEIGHTS.biases[0]
        close(got, np.maximum(expected, 0), atol=1e-4)


def test_identical_images_have_no_distance_and_others_have_whichever_comes_first():
    close(measure(IMAGE, IMAGE, WEIGHTS), np.zeros(2))
    forward = measure(IMAGE, REFERENCE, WEIGHTS)
    assert (forward > 0.1).all()
    close(measure(REFERENCE, IMAGE, WEIGHTS), forward)


def test_batches_of_every_rank_are_the_images_alone():
    whole = measure(IMAGE, REFERENCE, WEIGHTS)
    close(measure(IMAGE[0], REFERENCE[0], WEIGHTS), whole[0])
    close(measure(IMAGE[None], REFERENCE[None], WEIGHTS), whole[None])
    close(jax.vmap(lambda a, b: lpips(a, b, WEIGHTS))(IMAGE, REFERENCE), whole)


def test_gradients_are_finite_also_where_all_features_are_zero():
    silent = WEIGHTS.replace(biases=tuple(np.full_like(bias, -1e3) for bias in WEIGHTS.biases))
    gradient = jax.jit(jax.grad(lambda image, weights: lpips(image, REFERENCE[0], weights)))
    for image, weights in ((IMAGE[0], WEIGHTS), (REFERENCE[0], WEIGHTS), (IMAGE[0], silent)):
        assert jnp.isfinite(gradient(image, weights)).all()
    assert jnp.abs(gradient(IMAGE[0], WEIGHTS)).max() > 0
    assert (jax.grad(lambda x: normalised(x).sum())(jnp.zeros((2, 5))) == 0).all()


def test_a_head_of_zeros_leaves_its_layer_out():
    alone = []
    for i in range(5):
        heads = tuple(head if i == j else np.zeros_like(head) for j, head in enumerate(WEIGHTS.heads))
        alone.append(measure(IMAGE, REFERENCE, WEIGHTS.replace(heads=heads)))
    close(sum(alone), measure(IMAGE, REFERENCE, WEIGHTS))


def test_an_image_too_small_for_the_network_says_how_large_it_must_be():
    assert np.isfinite(measure(IMAGE[:, :SMALLEST, :SMALLEST], REFERENCE[:, :SMALLEST, :SMALLEST], WEIGHTS)).all()
    with pytest.raises(ValueError, match="at least 31 pixels"):
        lpips(IMAGE[:, :30], REFERENCE[:, :30], WEIGHTS)
