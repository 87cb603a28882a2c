"""Figure 1 of the supplement: the adversarial loss with weight 1 beside L1 losses of weight 0, 100 and 5000.

    python -m experiments.paper.fig1 --data DIR --out DIR [--steps N] [--pretrain N] [--l1-weights 0 100]

    OUT/runs/l1_WEIGHT/                run folders; finished ones are only read.  OUT/runs/pretrained/
    OUT/results.json  table.md         scores, high-frequency energy over the reference's, weight 100 minus the others
    OUT/gallery.png                    the figure, with that number below each picture

The runs differ in the L1 weight alone: same first weights, batches and steps, and the discriminator takes part from the
first step on, whatever the preset does.  By default they start from scratch: so the picture of weight 0 owes nothing to
an L1 loss.  From scratch the adversarial loss alone needs far more steps than a CPU has patience for, and its pictures
then show that it has not converged, not what it converges to.  With --pretrain N all of them start from one network
that was trained for N steps with the L1 loss alone (weight 100): the fair comparison of a small budget, in which the
weights decide where each goes from there.
"""

import dataclasses
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import tyro

from experiments import entry_point
from experiments.comparison import variants
from experiments.comparison.variants import Budget, Variant
from spnr_jax.config import TrainConfig
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.training import optimisation, trainer
from spnr_jax.training.weights import read_trained


@dataclass(frozen=True, kw_only=True)
class Fig1:
    """Train one network for each weight of the L1 loss beside the adversarial one, and compare their pictures."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of runs and results; the same command goes on there."""
    l1_weights: tuple[float, ...] = (0.0, 100.0, 5000.0)
    """Weights of the L1 loss; differences are to 100, or to the first of them."""
    pretrain: int = 0
    """Steps with the L1 loss alone that all runs start after; 0 starts from scratch."""
    budget: tyro.conf.OmitArgPrefixes[Budget] = field(default_factory=Budget)

    def __post_init__(self) -> None:
        if not self.l1_weights or min(self.l1_weights) < 0 or len(set(self.l1_weights)) < len(self.l1_weights):
            raise UserError(f"--l1-weights: expected distinct numbers from 0 on, got {list(self.l1_weights)}")
        if self.pretrain < 0:
            raise UserError(f"--pretrain: expected 0 or more steps, got {self.pretrain}")


def main(options: Fig1) -> None:
    """Trains what is not trained, scores all weights, writes tables and pictures."""
    dataset = data_sets.open_dataset(options.data)
    runs = [variant(options, weight, options.budget.config(), dataset) for weight in options.l1_weights]
    reference = runs[options.l1_weights.index(100.0) if 100.0 in options.l1_weights else 0].name
    variants.study(options.out, "fig1", runs, reference, options.budget, dataset, pretrain=options.pretrain)


def variant(options: Fig1, weight: float, config: TrainConfig, dataset: data_sets.Dataset) -> Variant:
    """The training with one weight of the L1 loss."""
    loss = dataclasses.replace(config.loss, l1_weight=weight, adversarial_weight=1.0, adversarial_start=0.0)
    return Variant(
        name=f"l1_{weight:g}",
        label=f"L1 weight {weight:g}",
        config=dataclasses.replace(config, loss=loss),
        dataset=dataset,
        start=partial(pretrain, options, dataset) if options.pretrain else None,
    )


def pretrain(options: Fig1, dataset: data_sets.Dataset, config: TrainConfig) -> optimisation.TrainState:
    """A fresh state whose generator was trained with the L1 loss alone."""
    loss = dataclasses.replace(config.loss, l1_weight=100.0, adversarial_weight=0.0)
    before = dataclasses.replace(config, loss=loss, num_steps=options.pretrain)
    run = options.out / "runs" / "pretrained"
    print(f"before it, {options.pretrain} steps of the L1 loss alone in {run}", flush=True)
    variants.train_one(before, dataset, run)
    return trainer.new_state(config, read_trained(run))


if __name__ == "__main__":
    entry_point.run(main, Fig1, "paper.fig1")
