"""How different pictures look to people: FLIP and LPIPS, by the packages of their authors; 0 is the same.

Pictures are sRGB in [0, 1], (*batch, height, width, 3).  FLIP (Andersson et al. 2020, low dynamic range) compares what
the eye resolves at PIXELS_PER_DEGREE, by the package `flip-evaluator`.  LPIPS (Zhang et al. 2018, version 0.1, AlexNet)
compares features of a trained network; it is measured where the package `lpips` is installed and finds its weights.
"""

import importlib
from functools import cache
from typing import Any

import numpy as np
from flip_evaluator import evaluate
from jaxtyping import Float

from spnr_jax.kernels.records import AnyArray

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * np.pi / 180  # 67.02: a 4K screen 0.7 m wide, seen from 0.7 m
NO_LPIPS = "n/a (pip install lpips)"
SMALLEST = 32  # pixels along a side that AlexNet takes


def flip(
    image: Float[AnyArray, "*batch height width 3"], reference: Float[AnyArray, "*batch height width 3"]
) -> Float[np.ndarray, "*batch"]:
    """Mean of FLIP's error map."""
    pairs = zip(_views(reference), _views(image), strict=True)
    asked = {"applyMagma": False, "computeMeanError": False, "parameters": {"ppd": PIXELS_PER_DEGREE}}
    means = [evaluate(wanted, shown, "LDR", **asked)[0].mean(dtype=np.float64) for wanted, shown in pairs]
    return np.array(means).reshape(np.shape(image)[:-3])


def lpips(
    image: Float[AnyArray, "*batch height width 3"], reference: Float[AnyArray, "*batch height width 3"]
) -> Float[np.ndarray, "*batch"] | None:
    """LPIPS; None where it cannot be measured."""
    network = lpips_network()
    if network is None or min(np.shape(image)[-3:-1]) < SMALLEST:
        return None
    torch = importlib.import_module("torch")
    shown, wanted = (torch.from_numpy(2 * np.moveaxis(_views(x), -1, 1) - 1) for x in (image, reference))
    with torch.no_grad():
        return network(shown, wanted).numpy().reshape(np.shape(image)[:-3])


@cache
def lpips_network() -> Any:
    """The network of the package `lpips`; None without the package or without its weights."""
    try:
        return importlib.import_module("lpips").LPIPS(net="alex", verbose=False).eval()
    except (ImportError, OSError):  # the weights of AlexNet are downloaded once
        return None


def _views(pictures: AnyArray) -> Float[np.ndarray, "views height width 3"]:
    """The pictures one after the other, float32, in memory that may be written to, as the packages want it."""
    return np.array(pictures, np.float32, order="C").reshape(-1, *np.shape(pictures)[-3:])
