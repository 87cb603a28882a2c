"""LPIPS weights on disk: one .npz of fifteen arrays, kernel_0 ... kernel_4, bias_0 ..., head_0 ..., channels last.

They are made once from two files that others publish: AlexNet's weights as torchvision gives them out
(`alexnet-owt-....pth`) and LPIPS's linear heads, version 0.1 (`alex.pth`).  Only `convert` needs PyTorch.
"""

import importlib
import pickle
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.images import write_whole
from spnr_jax.formats.npz import packed, read_arrays
from spnr_jax.scoring.lpips import CHANNELS, WINDOWS, LpipsWeights

CONVOLUTIONS = (0, 3, 6, 8, 10)  # places of the convolutions among AlexNet's features
INPUTS = (3, *CHANNELS[:-1])
SHAPES = {
    **{f"kernel_{i}": (n, n, inner, c) for i, (n, inner, c) in enumerate(zip(WINDOWS, INPUTS, CHANNELS, strict=True))},
    **{f"bias_{i}": (c,) for i, c in enumerate(CHANNELS)},
    **{f"head_{i}": (c,) for i, c in enumerate(CHANNELS)},
}


def read_weights(path: Path) -> LpipsWeights:
    """The weights of a file; ValueError that says what is wrong with it."""
    advice = "make it with `spnr convert-lpips`"
    if not path.is_file():
        raise UserError(f"{path}: no such file of LPIPS weights; {advice}")
    try:
        with path.open("rb") as file:
            arrays = read_arrays(file, SHAPES)
    except ValueError as error:
        raise UserError(f"{path}: not an .npz file of LPIPS weights ({error}); {advice}") from None
    return from_arrays(arrays, path)


def from_arrays(arrays: dict[str, np.ndarray], path: Path) -> LpipsWeights:
    """The weights as a pytree of float32; ValueError unless every array is there, has its shape, and is finite."""
    for name, shape in SHAPES.items():
        found = arrays[name].shape if name in arrays else "nothing"
        if found != shape:
            raise UserError(f"{path}: {name} should be an array {shape}, found {found}; use AlexNet and heads v0.1")
        if not np.isfinite(arrays[name]).all():
            raise UserError(f"{path}: {name} holds NaN or infinity; fetch the file anew")

    def five(name):
        return tuple(np.asarray(arrays[f"{name}_{i}"], np.float32) for i in range(len(CHANNELS)))

    return LpipsWeights(kernels=five("kernel"), biases=five("bias"), heads=five("head"))


def convert(alexnet: Path, heads: Path, out: Path) -> None:
    """Writes the .npz of torchvision's AlexNet weights and LPIPS's linear heads; other entries are left out."""
    trunk, linear = _read_state(alexnet), _read_state(heads)
    arrays = {}
    for i, place in enumerate(CONVOLUTIONS):
        kernel = _entry(trunk, f"features.{place}.weight", alexnet)
        arrays[f"kernel_{i}"] = np.moveaxis(kernel, (0, 1), (-1, -2))  # (out, in, h, w) -> (h, w, in, out)
        arrays[f"bias_{i}"] = _entry(trunk, f"features.{place}.bias", alexnet)
        arrays[f"head_{i}"] = _entry(linear, f"lin{i}.model.1.weight", heads).ravel()
    from_arrays(arrays, out)
    write_whole(out, packed(arrays))


def _read_state(path: Path) -> dict:
    """The tensors of a PyTorch file, read without running what a pickle may hold."""
    if not path.is_file():
        raise UserError(f"{path}: no such file; give a .pth file of weights")
    try:
        torch = importlib.import_module("torch")
    except ModuleNotFoundError:
        raise UserError("converting LPIPS weights needs PyTorch; `pip install torch`, once, anywhere") from None
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, pickle.UnpicklingError) as error:
        reason = str(error).partition("\n")[0]
        raise UserError(f"{path}: not a PyTorch file of weights ({reason})") from None


def _entry(state: dict, name: str, path: Path) -> np.ndarray:
    if name not in state:
        raise UserError(f"{path}: {name} is missing; expected torchvision's AlexNet and LPIPS's heads v0.1 (alex.pth)")
    return state[name].numpy()
