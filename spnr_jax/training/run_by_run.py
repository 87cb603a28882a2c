"""Runs that `jax.vmap` maps over, computed one after the other on a CPU: a run's arrays then stay in its caches."""

from collections.abc import Callable
from typing import Any

import jax
from jax import lax


def run_by_run(function: Callable) -> Callable:
    """The function of trees of arrays, without a gradient; under vmap a loop on a CPU, elsewhere vmap as it is."""
    single = jax.custom_batching.custom_vmap(function)

    @single.def_vmap
    def mapped(axis_size: int, in_batched: Any, *arguments: Any) -> tuple[Any, Any]:
        del axis_size
        leaves, tree = jax.tree.flatten(arguments)
        batched = jax.tree.leaves(in_batched)
        moving = [x for x, moves in zip(leaves, batched, strict=True) if moves]

        def whole(parts: list) -> tuple:
            rest = iter(parts)
            return jax.tree.unflatten(
                tree, [next(rest) if moves else x for x, moves in zip(leaves, batched, strict=True)]
            )

        out = lax.platform_dependent(
            moving,
            cpu=lambda parts: lax.map(lambda one: single(*whole(one)), parts),
            default=jax.vmap(lambda one: function(*whole(one))),
        )
        return out, jax.tree.map(lambda _: True, out)

    return single
