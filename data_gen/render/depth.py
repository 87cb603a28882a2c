"""True depth: how far rays go until they meet an object's mesh, by Mitsuba's ray casting.

Distances are along the rays, whose directions have unit length (not the camera's z), in the units of the asset: those
of a normalised object are the units of `spnr_jax.kernels.records.Rendering.depth`.  Faces are met from both sides.
"""

from collections.abc import Callable

import numpy as np

from data_gen.render.variant import mitsuba_module
from data_gen.render.views import build_scene
from spnr_jax.formats.mesh.assets import Asset

NO_LIGHT = np.zeros((4, 8, 3), np.float32)

Caster = Callable[[np.ndarray, np.ndarray], np.ndarray]


def caster(asset: Asset) -> Caster:
    """A function of origins and unit directions (rays, 3): distances (rays,) float32, inf where a ray misses."""
    mi, scene = mitsuba_module(), build_scene(asset, NO_LIGHT).handle

    def cast(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        if mi.variant().startswith("scalar"):
            rays = (mi.Ray3f(o=o, d=d, time=0, wavelengths=[]) for o, d in zip(origins, directions, strict=True))
            found = [scene.ray_intersect_preliminary(ray).t for ray in rays]
        else:
            o, d = (np.asarray(x, np.float32).T for x in (origins, directions))
            found = scene.ray_intersect_preliminary(mi.Ray3f(o=o, d=d, time=0, wavelengths=[])).t
        return np.array(found, np.float32)

    return cast
