"""3D Gaussian splats (Kerbl et al. 2023, their .ply layout) as coloured points.

    f_dc_0 f_dc_1 f_dc_2    the constant spherical-harmonic coefficient of each channel: sRGB = 0.5 + C0 * f_dc
    opacity                 before the logistic function

A splat's centre becomes a point; splats that are nearly transparent are dropped.  Shine is a property of the other
coefficients, so roughness and metallic stay unknown.
"""

import numpy as np

NAMES = ("f_dc_0", "f_dc_1", "f_dc_2", "opacity")
C0 = 0.5 / np.sqrt(np.pi)  # the constant spherical harmonic
LEAST_OPACITY = 0.2  # splats below it are fog, not surface


def points_of_splats(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns x y z red green blue (0 to 1) of the splats that are opaque enough."""
    kept = slice(None)
    if "opacity" in columns:
        kept = np.asarray(columns["opacity"], np.float64) >= np.log(LEAST_OPACITY / (1 - LEAST_OPACITY))
    colors = {
        color: np.clip(0.5 + C0 * columns[name][kept], 0, 1)
        for color, name in zip(("red", "green", "blue"), NAMES[:3], strict=True)
    }
    return {axis: columns[axis][kept] for axis in "xyz"} | colors
