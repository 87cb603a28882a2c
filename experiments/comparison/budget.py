"""The networks of the table: which preset each has in a budget, for how many steps it trains, and what that took.

    quick   the tiny presets for a few steps: the whole way, no quality
    tiny    the tiny presets, 64 px: minutes each on two cores
    paper   the published sizes, 128 px (ABO) or 200 px (ShapeNet): a GPU

Without `minutes` a network trains the steps of its preset.  With it, each trains as many steps as fit into so many
minutes on this machine, its warm-up and decay over exactly those: the pace is measured before the first step, and the
number is kept in the run's config.json.
"""

import dataclasses
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax

from experiments.baselines import PUBLISHED
from spnr_jax.config import TrainConfig
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.presets import PRESETS
from spnr_jax.training import batching, checkpoint, optimisation, trainer

Budget = Literal["quick", "tiny", "paper"]
NETWORKS = ("paper", "npbg", "point_nerf", "points2nerf")
QUICK_STEPS = 4
PAPER_SIZES = {128: "abo", 200: "shapenet"}
PACE_SECONDS, PACE_STEPS = 5.0, 3  # a pace is measured over at least so long and so many steps
SAVES = 40  # checkpoints and previews of a long run


@dataclass(frozen=True, kw_only=True)
class Trained:
    """A trained network, ready to be shown: and what it cost."""

    config: TrainConfig
    variables: dict
    cost: dict[str, str | int | float | None]


def configs(budget: Budget, size: int, category: str | None) -> dict[str, TrainConfig]:
    """The training of each network for images of so many pixels; ValueError if the paper has no such size."""
    if budget != "paper":
        return {name: PRESETS["tiny" if name == "paper" else f"{name}_tiny"]() for name in NETWORKS}
    if size not in PAPER_SIZES:
        raise UserError(
            f"--budget paper: the data's images have {size} pixels, the paper's 128 (ABO) or 200 (ShapeNet); generate "
            "with --resolution 128, or take --budget tiny"
        )
    paper = PAPER_SIZES[size] if size == 128 else f"shapenet_{category}"
    found = {"paper": PRESETS[paper if paper in PRESETS else "shapenet_car"]()}
    return found | {name: published(size) for name, published in PUBLISHED.items()}


def config_of(
    config: TrainConfig, budget: Budget, seed: int, minutes: float | None, dataset: data_sets.Dataset, run: Path
) -> TrainConfig:
    """The training with the seed and the steps of the budget; a run that was begun keeps its steps."""
    config = dataclasses.replace(config, seed=seed)
    if budget == "quick":
        return dataclasses.replace(config, num_steps=QUICK_STEPS)
    if minutes is None:
        return config
    begun = (run / "config.json").is_file()
    steps = checkpoint.read_config(run).num_steps if begun else steps_within(60 * minutes, config, dataset)
    return dataclasses.replace(config, num_steps=steps)


def steps_within(seconds: float, config: TrainConfig, dataset: data_sets.Dataset) -> int:
    """How many steps fit into so many seconds here, those with the discriminator at their share and pace."""
    alone = optimisation.first_adversarial_step(config) / config.num_steps
    pace = sum(
        share * step_seconds(config, dataset, adversarial)
        for share, adversarial in ((alone, False), (1 - alone, True))
        if share
    )
    return max(1, int(seconds / pace))


def step_seconds(
    config: TrainConfig,
    dataset: data_sets.Dataset,
    adversarial: bool,
    clock: Callable[[], float] = time.monotonic,
) -> float:
    """Seconds of a training step by a clock, reading the data included, compilation not."""
    state = optimisation.jitted_create_state(config)
    steps, start = -1, 0.0
    with closing(batching.batches(dataset, config, 0)) as batches:
        for batch in batches:
            state, metrics = optimisation.jitted_train_step(
                state, jax.device_put(batch), config=config, adversarial=adversarial
            )
            jax.block_until_ready(metrics)
            steps += 1
            if steps == 0:  # this one compiled
                start = clock()
            elif steps >= PACE_STEPS and clock() - start >= PACE_SECONDS:
                break
    return (clock() - start) / max(steps, 1)


def train(config: TrainConfig, dataset: data_sets.Dataset, run: Path) -> Trained:
    """The network after its last step; a finished run is only read."""
    every = max(500, config.num_steps // SAVES)
    schedule = trainer.Schedule(preview_every=every, checkpoint_every=every)
    state = trainer.train(config, dataset, run, schedule)
    variables = optimisation.averaged_variables(state)
    cost = {
        "preset": config.preset,
        "parameters": sum(x.size for x in jax.tree.leaves(variables["params"])),
        "steps": int(state.step),
        "training_seconds": training_seconds(run),
    }
    return Trained(config=config, variables=variables, cost=cost)


def training_seconds(run: Path) -> float:
    """Seconds that a run's steps took over all calls, from its log: not compilation, previews and saving."""
    seconds, before = 0.0, 0
    for row in trainer.read_rows(run):
        if "ms_per_step" in row:
            seconds += (row["step"] - before) * row["ms_per_step"] / 1000
            before = row["step"]
    return round(seconds, 2)
