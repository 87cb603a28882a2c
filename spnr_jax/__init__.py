"""Sparse-point neural rendering: surface points with materials in, pictures of the object out.

`import spnr_jax` does not import JAX: each public name is imported at its first use.
"""

import warnings
from importlib import import_module, metadata

from jaxlib import version  # without JAX

_PUBLIC = {"load": "training.weights", "Model": "method.model", "Volume": "kernels.records"}
_PUBLIC |= dict.fromkeys(("Plan", "plan", "render"), "method.surfel_renderer")
_PUBLIC |= {"neighbors": "surfels.neighbors", "encode": "method.surfel_renderer", "densify": "method.densifier"}
_PUBLIC |= {"read_cloud": "formats.clouds", "make_cloud": "kernels.cloud_arrays", "clean": "kernels.cleaning"}
_PUBLIC |= {"read_cameras": "formats.camera_files"}
_PUBLIC |= {"splats": "tools.surfaces", "write_splats": "formats.gaussian_files"}
_PUBLIC |= {"read_light": "formats.images", "sun": "surfels.skies"}
_PUBLIC |= dict.fromkeys(("light_of", "ambient"), "surfels.lighting")
_PUBLIC |= dict.fromkeys(
    ("PointCloud", "Camera", "Light", "Gaussians", "Rays", "Rendering", "Batch"), "kernels.records"
)
_KERNELS = ("cameras", "sampling", "compositing", "voxels", "losses", "metrics")

WRONG = {"0.10.2": "jax-ml/jax#39103"}  # versions of jaxlib that compute wrong numbers -> the issue

__all__ = sorted(_PUBLIC)


def warn_of_wrong_numbers() -> None:
    """Warns, in one line, if the installed jaxlib is known to compute wrong numbers."""
    found = version.__version__
    if found in WRONG:
        line = f"jaxlib {found} computes wrong numbers on a CPU ({WRONG[found]}): pip install 'jax!={found}'"
        warnings.warn(line, stacklevel=3)


warn_of_wrong_numbers()


def __dir__() -> list[str]:
    """The public names."""
    return sorted([*__all__, *_KERNELS])


def __getattr__(name: str):
    """Imports a public name or a kernel module at its first use, so that importing the package is fast."""
    if name in _KERNELS:
        return import_module(f"spnr_jax.kernels.{name}")
    if name == "__version__":
        return metadata.version("spnr-jax")
    if name not in _PUBLIC:
        raise AttributeError(f"module 'spnr_jax' has no attribute {name!r}")
    return getattr(import_module(f"spnr_jax.{_PUBLIC[name]}"), name)
