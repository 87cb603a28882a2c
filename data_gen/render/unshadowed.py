"""An asset in a light that nothing keeps away: an oracle of what shading alone can reach, without light transport.

Each pixel shows the reflected light of the whole map as if its surface point stood alone: no shadows, no bounces.  With
occlusion that is multiplied by the point's ambient occlusion, the cosine-weighted share of its hemisphere that is
open.  Materials, cameras and film are those of the references (`views.py`).
"""

import importlib
from typing import Any

import numpy as np

from data_gen.render.variant import mitsuba_module
from data_gen.render.views import Scene, ViewConfig, make_sensor
from spnr_jax.errors import UserError


def render_unshadowed(
    scene: Scene, cam_to_world: np.ndarray, config: ViewConfig, seed: int, occlusion: bool = False
) -> np.ndarray:
    """The picture (height, width, 4): linear radiance premultiplied by alpha, and alpha, float32.

    ValueError with the scalar variant, in which integrators of Python end the process.
    """
    mi = mitsuba_module()
    if mi.variant().startswith("scalar"):
        raise UserError("pictures without shadows need Mitsuba's llvm_ad_rgb; install LLVM 17 or newer")
    sensor = make_sensor(cam_to_world, config, config.resolution)
    image = mi.render(scene.handle, sensor=sensor, integrator=_integrator(occlusion), spp=config.spp, seed=seed)
    return np.array(image, dtype=np.float32)


def _integrator(occlusion: bool) -> Any:
    """An integrator of direct light that tests no shadow ray; Mitsuba's classes exist once it has a variant."""
    mi, dr = mitsuba_module(), importlib.import_module("drjit")
    integrator: Any = mi.SamplingIntegrator

    class Unshadowed(integrator):
        """Light of the map by both ways of sampling it (balance heuristic, Veach 1995)."""

        def sample(self, scene, sampler, ray, medium=None, active=True):
            """Radiance, whether the ray hits the object, and no more."""
            hit = scene.ray_intersect(ray, active)
            active = active & hit.is_valid()
            bsdf, context = hit.bsdf(ray), mi.BSDFContext()
            towards, radiance = scene.sample_emitter_direction(hit, sampler.next_2d(active), False, active)
            reflected, density = bsdf.eval_pdf(context, hit, hit.to_local(towards.d), active)
            share = towards.pdf / (towards.pdf + density)
            total = dr.select(towards.pdf > 0, share * reflected * radiance, 0)
            drawn, weight = bsdf.sample(context, hit, sampler.next_1d(active), sampler.next_2d(active), active)
            sky = dr.zeros(mi.SurfaceInteraction3f)
            sky.wi = -hit.to_world(drawn.wo)
            towards = dr.zeros(mi.DirectionSample3f)
            towards.d = hit.to_world(drawn.wo)
            density = scene.environment().pdf_direction(hit, towards, active)
            share = drawn.pdf / (drawn.pdf + density)
            total += dr.select(drawn.pdf > 0, share * weight * scene.environment().eval(sky, active), 0)
            if occlusion:  # a ray of its own: the mean of the product is the product of the means
                upward = mi.warp.square_to_cosine_hemisphere(sampler.next_2d(active))
                upward.z = dr.copysign(upward.z, hit.wi.z)
                total = dr.select(scene.ray_test(hit.spawn_ray(hit.to_world(upward)), active), 0, total)
            return dr.select(active, total, 0), active, []

    return Unshadowed(mi.Properties())
