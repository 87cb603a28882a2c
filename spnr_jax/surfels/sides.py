"""Orientation of normals: votes of the directions that see a layer, and of opposite walls.

Pure functions of a block of points, which are the last axis.  Votes are constants: they turn a normal or leave it, and
have no gradient.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from spnr_jax.kernels.numerics import clamp
from spnr_jax.surfels.layers import Hood, Layer, along, weigh_height, weigh_near
from spnr_jax.surfels.rules import Rules
from spnr_jax.surfels.small_systems import dot, total
from spnr_jax.surfels.visibility import DIRECTIONS


def count_facing(
    normal: Float[Array, "3 points"], seen: Float[Array, "64 points"]
) -> tuple[Float[Array, " points"], Float[Array, " points"]]:
    """How many directions before each point see it, counted by their cosines with its normal, and how many behind."""

    def add(sums: tuple[Array, Array], one: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        counted = one[1] * dot(one[0], normal)
        return (sums[0] + jnp.maximum(counted, 0), sums[1] - jnp.minimum(counted, 0)), None

    zeros = jnp.zeros_like(normal[0])
    return jax.lax.scan(add, (zeros, zeros), (jnp.asarray(DIRECTIONS, normal.dtype), seen))[0]


def share_votes(
    hood: Hood,
    layer: Layer,
    spacing: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
    leans: Float[Array, "k block"],
    rules: Rules,
) -> Float[Array, " block"]:
    """The lean of each point and of its neighbors on the same layer, whichever way their normals point."""
    cosine = along(normals, layer.normal)
    weight = weigh_near(hood, spacing, rules) * weigh_height(layer) * cosine**2
    return total(weight * jnp.sign(cosine) * leans) / jnp.maximum(total(weight), 1e-6)


def vote_of_walls(
    hood: Hood,
    layer: Layer,
    spacing: Float[Array, " block"],
    normals: Float[Array, "k 3 block"],
    given: Bool[Array, " block"],
    rules: Rules,
) -> Float[Array, " block"]:
    """A lean from another layer, nearer than anything can be seen between: a wall's sides face away from each other.

    A layer right under another, as under a sticker, is taken for a wall's inner side, and not seen from outside either;
    given normals tell the two apart.
    """
    cosine = along(normals, layer.normal)
    other = jnp.where(given[None], -cosine, jnp.abs(cosine)) > rules.parallel
    wall = weigh_near(hood, spacing, rules) * other * (jnp.abs(layer.height) < rules.wall)
    thin = given & (layer.scale <= rules.scales[0])
    scale = jnp.where(thin, rules.sheet_scale, layer.scale)
    outward = layer.height / scale[None]
    above, below = total(wall * (outward > rules.apart)), total(wall * (outward < -rules.apart))
    return rules.wall_vote * (below - above) / (above + below + rules.evidence)


def turn_outward(
    normal: Float[Array, "3 block"],
    towards: Float[Array, " block"],
    front: Float[Array, " block"],
    back: Float[Array, " block"],
    given: Bool[Array, " block"],
    rules: Rules,
) -> tuple[Float[Array, "3 block"], Float[Array, " block"]]:
    """Normals that point outward, and 1 where the votes say which side that is, 0 where they do not.

    Given normals have a side; they are turned only where the votes are clear.
    """
    begin, end = rules.sure_side
    sided = clamp((jnp.abs(towards) - begin) / (end - begin), 0, 1)
    wrong = towards < jnp.where(given, -rules.turn, 0)
    sided = jnp.where(jnp.where(wrong, front, back) > rules.hidden, jnp.minimum(sided, 1 - rules.leak), sided)
    return jnp.where(wrong[None], -normal, normal), jax.lax.stop_gradient(sided)


def find_shown(
    seen: Float[Array, " all"], covered: Bool[Array, " all"], mask: Bool[Array, " all"], rules: Rules
) -> Bool[Array, " all"]:
    """Which real points something outside sees; all, where that would leave too few."""
    shown = mask & ~covered & (seen > rules.hidden)
    return jnp.where(jnp.sum(shown) > rules.least_shown * jnp.sum(mask), shown, mask)
