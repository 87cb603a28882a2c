"""Figure 1: the runs differ in the L1 weight alone, from scratch or from one network that the L1 loss trained."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support import tiny_dataset
from support.laws import same_bits
from support.tiny_runs import L1_ONLY, check_conditions, results_of, shrunken

from experiments.comparison.variants import QUICK_STEPS, Budget
from experiments.paper.fig1 import Fig1, main, pretrained, variant
from spnr_jax import config, presets
from spnr_jax.training import adversary, checkpoint

pytestmark = pytest.mark.ci  # it trains several networks


@pytest.fixture(scope="module", autouse=True)
def _shrunken():
    with shrunken():
        yield


def asked(out, **options):
    budget = Budget(quick=True, shown=1)
    return Fig1(data=tiny_dataset.dataset().folder, out=out, budget=budget, **{"l1_weights": (0.0, 100.0)} | options)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fig1") / "out"
    main(asked(folder, pretrain=2))
    return folder


def test_the_adversarial_loss_takes_part_from_the_first_step_and_the_weights_alone_differ():
    options = Fig1(data=tiny_dataset.dataset().folder, out=tiny_dataset.folder())
    made = [variant(options, weight, presets.tiny(), tiny_dataset.dataset()) for weight in options.l1_weights]
    assert [v.config.loss.l1_weight for v in made] == [0, 100, 5000]
    for v in made:
        assert (v.config.loss.adversarial_weight, adversary.first_adversarial_step(v.config)) == (1, 0)
        assert v.start is None
        assert dataclasses.replace(v.config, loss=config.LossConfig()) == dataclasses.replace(
            presets.tiny(), loss=config.LossConfig()
        )


def test_every_weight_has_its_pictures_and_its_high_frequency_energy(out):
    results = results_of(out)
    assert set(results["variants"]) == {"l1_0", "l1_100"}
    assert results["reference"] == "l1_100"
    assert results["start"] == "2 steps of L1 alone"
    assert {row["steps"][0] for row in results["variants"].values()} == {QUICK_STEPS}
    for row in results["variants"].values():
        assert row["detail"] > 0
    check_conditions(out)


def test_all_weights_start_from_the_network_that_the_l1_loss_trained(out):
    _, before = checkpoint.load_run(out / "runs" / "pretrained_0")
    options = asked(out, pretrain=2)
    for weight in options.l1_weights:
        wanted = variant(options, weight, dataclasses.replace(L1_ONLY, num_steps=QUICK_STEPS), tiny_dataset.dataset())
        assert checkpoint.read_config(out / "runs" / f"{wanted.name}_0") == wanted.config
        start = pretrained(options, tiny_dataset.dataset(), wanted.config)
        assert start.step == 0
        same_bits((start.generator, start.averaged), (before.averaged,) * 2)
        same_bits((start.batch_stats, start.averaged_stats), (before.averaged_stats,) * 2)
        assert np.isfinite(start.discriminator["kernel_0"]).all()


def test_all_weights_start_from_a_network_that_is_named(out):
    run = out / "runs" / "l1_0_0"
    _, before = checkpoint.load_run(run)
    start = pretrained(asked(out, init=run), tiny_dataset.dataset(), dataclasses.replace(L1_ONLY, num_steps=2))
    same_bits((start.generator, start.averaged), (before.averaged,) * 2)
    with pytest.raises(ValueError, match="leave --pretrain out"):
        asked(out, init=run, pretrain=2)
    with pytest.raises(ValueError, match="another pretrain, init; choose another --out"):
        main(asked(out, init=run))


def test_a_start_that_is_not_there_or_of_another_network_is_said_before_anything_is_written(tmp_path):
    for init, said in ((tmp_path / "none.npz", "no such file"), (Path("small"), "are of another network")):
        with pytest.raises(ValueError, match=said):
            main(asked(tmp_path / "out", init=init))
    assert not any(tmp_path.iterdir())
