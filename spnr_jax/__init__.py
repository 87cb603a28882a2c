"""Sparse-point neural rendering: surface points with materials in, pictures of the object out.

`import spnr_jax` does not import JAX: each public name is imported at its first use.
"""

import warnings
from importlib import import_module, metadata
from typing import TYPE_CHECKING

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

if TYPE_CHECKING:  # the same names, for type checkers and editors
    from spnr_jax.formats.camera_files import read_cameras as read_cameras
    from spnr_jax.formats.clouds import read_cloud as read_cloud
    from spnr_jax.formats.gaussian_files import write_splats as write_splats
    from spnr_jax.formats.images import read_light as read_light
    from spnr_jax.kernels import (
        cameras as cameras,
        compositing as compositing,
        losses as losses,
        metrics as metrics,
        sampling as sampling,
        voxels as voxels,
    )
    from spnr_jax.kernels.cleaning import clean as clean
    from spnr_jax.kernels.cloud_arrays import make_cloud as make_cloud
    from spnr_jax.kernels.records import (
        Batch as Batch,
        Camera as Camera,
        Gaussians as Gaussians,
        Light as Light,
        PointCloud as PointCloud,
        Rays as Rays,
        Rendering as Rendering,
        Volume as Volume,
    )
    from spnr_jax.method.densifier import densify as densify
    from spnr_jax.method.model import Model as Model
    from spnr_jax.method.surfel_renderer import Plan as Plan, encode as encode, plan as plan, render as render
    from spnr_jax.surfels.lighting import ambient as ambient, light_of as light_of
    from spnr_jax.surfels.neighbors import neighbors as neighbors
    from spnr_jax.surfels.skies import sun as sun
    from spnr_jax.tools.surfaces import splats as splats
    from spnr_jax.training.weights import load as load

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
