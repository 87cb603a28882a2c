"""Gradients of a first training step on one device and on several that share each volume: how far they lie apart.

    python -m experiments.distributed_gradients DATA DEVICES PRECISION OPTIONS...    one line of JSON

Options are those of `spnr train`.  Adam turns gradients near zero into whole steps, so parameters after it say little.
In float64 what is left of a right division is rounding at 1e-12, and what is left of a wrong one is what is wrong; in
float32 sums over millions of voxels that nearly cancel keep few digits, on any number of devices.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from experiments.virtual_devices import in_child
from spnr_jax import cli
from spnr_jax.config import TrainConfig
from spnr_jax.devices import placement
from spnr_jax.formats import data_sets
from spnr_jax.training import batching, optimisation

PRECISIONS = ("float32", "float64")


def measured(dataset: Path, devices: int, options: Sequence[str]) -> dict[str, dict[str, Any]]:
    """`apart` by precision, each of a process that sees so many devices."""
    return {
        precision: in_child(
            __name__,
            devices,
            [str(dataset), str(devices), precision, *options],
            environment={"JAX_ENABLE_X64": str(int(precision == "float64"))},
        )
        for precision in PRECISIONS
    }


def apart(config: TrainConfig, dataset: data_sets.Dataset, mesh: Mesh, precision: str = "float32") -> dict[str, Any]:
    """Relative difference of the loss, and of the array of gradients that differs most, by its largest entry."""
    batch = next(batching.batches(dataset, config, 0))
    losses, gradients = [], []
    for devices in (None, mesh):
        with placement.using(devices):
            state, metrics = optimisation.jitted_train_step(
                in_precision(optimisation.jitted_create_state(config), precision),
                placement.placed(in_precision(batch, precision), devices, config.batch_objects),
                config=config,
                adversarial=False,
            )
        losses.append(float(metrics["loss"]))
        gradients.append(jax.device_get(state.generator_optimizer[0].mu))  # of one step their mean is a multiple
    pairs = zip(jax.tree_util.tree_leaves_with_path(gradients[0]), jax.tree.leaves(gradients[1]), strict=True)
    by_array = {
        jax.tree_util.keystr(path, simple=True, separator="."): distance(other, one) for (path, one), other in pairs
    }
    worst = max(by_array, key=lambda name: by_array[name])
    return {
        "loss": abs(losses[1] / losses[0] - 1),
        "gradients": by_array[worst],
        "array": worst,
        "median": float(np.median(list(by_array.values()))),
    }


def in_precision(tree: Any, precision: str) -> Any:
    """The tree with its float32 arrays in a precision."""
    return jax.tree.map(lambda x: x.astype(precision) if x.dtype == np.float32 else x, tree)


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference, as a share of the largest entry of the second; 0 of zeros."""
    return float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-30))


def main(dataset: Path, devices: int, precision: str, options: Sequence[str]) -> None:
    """Prints `apart` for the config that options of `spnr train` make."""
    command = cli.parse(["train", str(dataset), "run", *options])
    assert isinstance(command, cli.Train)
    mesh = placement.device_mesh(devices)
    print(json.dumps(apart(command.config, data_sets.open_dataset(dataset), mesh, precision)))


if __name__ == "__main__":
    cli.set_up_jax()
    main(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3], sys.argv[4:])
