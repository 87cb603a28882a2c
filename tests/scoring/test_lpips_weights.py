"""A weight file is complete and finite or refused in one line; the converter moves every number to its place."""

import sys

import numpy as np
import pytest
from support.tiny_lpips import ARRAYS, WEIGHTS, files

from spnr_jax import cli
from spnr_jax.scoring import lpips_weights
from spnr_jax.scoring.lpips_weights import convert, read_weights
from spnr_jax.tools import commands


@pytest.fixture
def torch():
    return pytest.importorskip("torch", reason="needs PyTorch (extra bench)")


def written(folder, **changes):
    arrays = {name: array for name, array in (ARRAYS | changes).items() if array is not None}
    np.savez(folder / "w.npz", **arrays)
    return folder / "w.npz"


def test_reading_gives_what_was_written(tmp_path):
    weights = read_weights(written(tmp_path, head_2=np.float64(ARRAYS["head_2"])))
    for name in ("kernels", "biases", "heads"):
        for got, expected in zip(getattr(weights, name), getattr(WEIGHTS, name), strict=True):
            assert got.dtype == np.float32
            np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"head_4": None}, r"head_4 should be an array \(256,\), found nothing"),
        ({"kernel_0": np.zeros((64, 3, 11, 11), np.float32)}, r"kernel_0 should be an array \(11, 11, 3, 64\)"),
        ({"bias_1": np.full(192, np.nan, np.float32)}, "bias_1 holds NaN or infinity"),
    ],
)
def test_arrays_that_are_missing_of_another_shape_or_not_finite_are_named(changes, reason, tmp_path):
    with pytest.raises(ValueError, match=reason):
        read_weights(written(tmp_path, **changes))


@pytest.mark.parametrize("content", [b"", b"no zip", b"PK\x03\x04 nor this"])
def test_a_file_that_is_no_npz_is_named_with_what_to_do(content, tmp_path):
    (tmp_path / "w.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"w\.npz: not an \.npz file of LPIPS weights .*; .*convert-lpips"):
        read_weights(tmp_path / "w.npz")


def test_objects_in_the_file_are_refused_instead_of_run(tmp_path):
    np.savez(tmp_path / "w.npz", kernel_0=np.array([print], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="not an .npz file of LPIPS weights"):
        read_weights(tmp_path / "w.npz")


def test_missing_files_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"none\.npz: no such file of LPIPS weights; make it with"):
        read_weights(tmp_path / "none.npz")
    with pytest.raises(ValueError, match=r"none\.pth: no such file"):
        convert(tmp_path / "none.pth", tmp_path / "alex.pth", tmp_path / "w.npz")


def test_the_command_converts_what_the_reader_reads(torch, tmp_path, capsys):
    alexnet, heads = files(tmp_path, torch)
    cli.run(commands.ConvertLpips(alexnet=alexnet, heads=heads, out=tmp_path / "w.npz"))
    assert f"--lpips {tmp_path / 'w.npz'}" in capsys.readouterr().out
    weights = read_weights(tmp_path / "w.npz")
    for name in ("kernels", "biases", "heads"):
        for got, expected in zip(getattr(weights, name), getattr(WEIGHTS, name), strict=True):
            np.testing.assert_array_equal(got, expected)


def test_files_of_another_network_or_kind_are_refused_and_nothing_is_written(torch, tmp_path):
    alexnet, heads = files(tmp_path, torch)
    with pytest.raises(ValueError, match=r"alex\.pth: features\.0\.weight is missing"):
        convert(heads, alexnet, tmp_path / "w.npz")
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(ValueError, match=r"text\.pth: not a PyTorch file of weights"):
        convert(tmp_path / "text.pth", heads, tmp_path / "w.npz")
    torch.save({"features.0.weight": print}, tmp_path / "code.pth")
    with pytest.raises(ValueError, match=r"code\.pth: not a PyTorch file of weights"):
        convert(tmp_path / "code.pth", heads, tmp_path / "w.npz")
    assert not (tmp_path / "w.npz").exists()


def test_without_pytorch_the_converter_says_what_it_needs(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "torch", None)
    (tmp_path / "a.pth").write_bytes(b"")
    with pytest.raises(ValueError, match="needs PyTorch; `pip install torch`"):
        lpips_weights.convert(tmp_path / "a.pth", tmp_path / "a.pth", tmp_path / "w.npz")
