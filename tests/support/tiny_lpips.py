"""Random weights for LPIPS, and the two files that the converter makes them from."""

import numpy as np

from spnr_jax.scoring import lpips_weights
from spnr_jax.scoring.lpips import LpipsWeights


def random_arrays() -> dict[str, np.ndarray]:
    """Arrays of a weight file, of sizes that keep the features near 1; heads are not negative."""
    rng = np.random.default_rng(2)
    arrays = {}
    for name, shape in lpips_weights.SHAPES.items():
        if name.startswith("kernel"):
            arrays[name] = rng.normal(size=shape) * np.sqrt(2 / np.prod(shape[:3]))
        else:
            arrays[name] = rng.normal(size=shape) * 0.1 if name.startswith("bias") else rng.random(shape)
    return {name: np.float32(array) for name, array in arrays.items()}


ARRAYS = random_arrays()


def five(name: str) -> tuple[np.ndarray, ...]:
    return tuple(ARRAYS[f"{name}_{i}"] for i in range(5))


WEIGHTS = LpipsWeights(kernels=five("kernel"), biases=five("bias"), heads=five("head"))


def files(folder, torch):
    """The two files that the converter reads, holding ARRAYS and more, as torchvision and lpips write them."""
    trunk = {"classifier.1.weight": torch.zeros(2, 2)}
    heads = {}
    for i, place in enumerate((0, 3, 6, 8, 10)):
        trunk[f"features.{place}.weight"] = torch.tensor(ARRAYS[f"kernel_{i}"].transpose(3, 2, 0, 1).copy())
        trunk[f"features.{place}.bias"] = torch.tensor(ARRAYS[f"bias_{i}"])
        heads[f"lin{i}.model.1.weight"] = torch.tensor(ARRAYS[f"head_{i}"].reshape(1, -1, 1, 1))
    torch.save(trunk, folder / "alexnet.pth")
    torch.save(heads, folder / "alex.pth")
    return folder / "alexnet.pth", folder / "alex.pth"
