"""What a training step of one object takes: operations and bytes, counted from its program; nothing is run.

    python -m experiments.cost_counts [--preset abo]      one line of JSON

XLA's own analysis of the step with the discriminator, before and after it compiled it: operations are the same, bytes
shrink where it fuses.  Convolutions are XLA's own, the form of a GPU; the fusions are those of a CPU.  Machine code,
which takes no part in the counts, is optimised least.  The penalty R1, which only some steps compute, counts apart.
"""

import dataclasses
import json
import os
from dataclasses import dataclass
from typing import Any

import jax
import tyro

from experiments import distributed_memory
from spnr_jax import presets
from spnr_jax.config import TrainConfig
from spnr_jax.nn import convolution
from spnr_jax.training import optimisation


@dataclass(frozen=True, kw_only=True)
class CostCounts:
    """Count operations and bytes of a training step of one object."""

    preset: str = "abo"
    """Network and losses."""


def main(options: CostCounts) -> None:
    """Prints the counts."""
    convolution._conv3d_cpu = convolution._conv2d_cpu = convolution._native  # type: ignore[assignment]
    config = presets.PRESETS[options.preset]()
    without_r1 = dataclasses.replace(config, loss=dataclasses.replace(config.loss, r1_gamma=0.0))
    step = lowered(without_r1)
    whole, compiled = step.cost_analysis(), step.compile()
    fused: Any = compiled.cost_analysis()
    memory: Any = compiled.memory_analysis()
    counts = parameters(config) | {
        "operations": whole["flops"],
        "operations_of_r1": lowered(config).cost_analysis()["flops"] - whole["flops"],
        "bytes": fused["bytes accessed"],
        "bytes_unfused": whole["bytes accessed"],
        "temporary_bytes": memory.temp_size_in_bytes,
    }
    print(json.dumps(counts))


def lowered(config: TrainConfig) -> Any:
    """The step of one object with the discriminator, before it is compiled."""
    config = dataclasses.replace(config, batch_objects=1)
    state = jax.eval_shape(lambda: optimisation.create_state(config))
    batch = distributed_memory.batch_shapes(config)
    return optimisation.jitted_train_step.lower(
        state, batch, config=config, adversarial=state.discriminator is not None
    )


def parameters(config: TrainConfig) -> dict[str, int]:
    """Numbers of trained parameters, of those in a saved state, and of layers that average over all devices."""
    state = jax.eval_shape(lambda: optimisation.create_state(config))

    def count(*trees: Any) -> int:
        return sum(x.size for x in jax.tree.leaves(trees))

    return {
        "parameters": count(state.generator, state.discriminator),
        "saved": count(dataclasses.replace(state, key=None)),
        "batch_norms": len(jax.tree.leaves(state.batch_stats)) // 2,
    }


if __name__ == "__main__":
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
    main(tyro.cli(CostCounts, prog="python -m experiments.cost_counts"))
