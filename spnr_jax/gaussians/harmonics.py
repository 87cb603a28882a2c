"""Real spherical harmonics as splat viewers have them: degrees 0 to 3, with the Condon-Shortley phase.

The order is that of Kerbl et al. 2023 and of KHR_gaussian_splatting: by degree, then by order from -degree to degree.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from spnr_jax.errors import UserError
from spnr_jax.kernels.records import AnyArray

C0 = 0.28209479177387814  # sqrt(1 / 4 pi)
C1 = 0.4886025119029199  # sqrt(3 / 4 pi)
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
HIGHEST = 3  # degree


def coefficients(degree: int) -> int:
    """How many harmonics there are up to a degree."""
    return (degree + 1) ** 2


def degree_of(count: int) -> int:
    """The degree of so many coefficients; ValueError if they are of none."""
    for degree in range(HIGHEST + 1):
        if coefficients(degree) == count:
            return degree
    raise UserError(f"spherical harmonics have 1, 4, 9 or 16 coefficients, got {count}")


def basis(directions: Float[AnyArray, "*batch 3"], degree: int) -> Float[AnyArray, "*batch coefficients"]:
    """All harmonics up to a degree, 0 to 3, of unit vectors; of NumPy arrays as NumPy arrays."""
    x, y, z = (directions[..., i] for i in range(3))
    xx, yy, zz = x * x, y * y, z * z
    values = [C0 + 0 * x]
    if degree > 0:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree > 1:
        a, b, c = C2
        values += [a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, c * (xx - yy)]
    if degree > 2:
        a, b, c, d, e = C3
        values += [-a * y * (3 * xx - yy), b * x * y * z, -c * y * (4 * zz - xx - yy)]
        values += [d * z * (2 * zz - 3 * xx - 3 * yy), -c * x * (4 * zz - xx - yy)]
        values += [e * z * (xx - yy), -a * x * (xx - 3 * yy)]
    return np.stack(values, axis=-1) if isinstance(directions, np.ndarray) else jnp.stack(values, axis=-1)


def half_turn_signs(degree: int) -> Float[np.ndarray, " coefficients"]:
    """Signs of the coefficients of a colour that is turned half around the x axis: (x, y, z) -> (x, -y, -z)."""
    place = np.array([0.36, 0.48, 0.8])
    return np.sign(basis(place * [1, -1, -1], degree) * basis(place, degree))
