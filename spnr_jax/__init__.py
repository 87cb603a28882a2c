"""Sparse-point neural rendering: a thousand surface points with materials in, pictures of the object out."""

from importlib import import_module

_PUBLIC = {"load": "spnr_jax.model", "Model": "spnr_jax.model", "Volume": "spnr_jax.model"}
_PUBLIC |= {"read_cloud": "spnr_jax.clouds"}
_PUBLIC |= dict.fromkeys(("PointCloud", "Camera", "Rays", "Rendering", "Batch"), "spnr_jax.types")

__all__ = sorted(_PUBLIC)


def __getattr__(name: str):
    """Loads a public name on first use, so that importing the package stays quick."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'spnr_jax' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)
