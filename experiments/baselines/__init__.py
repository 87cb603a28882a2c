"""The published methods to compare with: `spnr train DATA RUN --methods experiments.baselines --preset npbg_tiny`."""

from experiments.baselines import npbg, point_nerf, points2nerf
from spnr_jax.methods import Method, register

for method in (
    Method(config=npbg.NPBGConfig, network=npbg.NPBG, presets=(npbg.npbg_tiny,), label="NPBG"),
    Method(
        config=point_nerf.PointNeRFConfig,
        network=point_nerf.PointNeRF,
        loss=point_nerf.loss,
        presets=(point_nerf.point_nerf_tiny,),
        label="Point-NeRF",
    ),
    Method(
        config=points2nerf.Points2NeRFConfig,
        network=points2nerf.Points2NeRF,
        loss=points2nerf.loss,
        presets=(points2nerf.points2nerf_tiny,),
        label="Points2NeRF",
    ),
):
    register(method)

PUBLISHED = {
    "npbg": npbg.published_config,
    "point_nerf": point_nerf.published_config,
    "points2nerf": points2nerf.published_config,
}
