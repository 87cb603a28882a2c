"""The learning rate over a training, and the algorithm that uses it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import optax
import pytest
from support.laws import close
from support.tiny_training import CONFIG

from spnr_jax.config import OptimizerConfig
from spnr_jax.training import optimisation


class TestLearningRate:
    @pytest.mark.parametrize(("warmup", "steps"), [(10, 100), (0, 50), (500, 100), (1, 1)])
    def test_rises_linearly_then_falls_by_a_cosine_to_its_last_share(self, warmup, steps):
        o = OptimizerConfig(lr_generator=2e-3, warmup_steps=warmup, final_lr_scale=0.1)
        rate = optimisation.learning_rate(dataclasses.replace(CONFIG, optimizer=o, num_steps=steps))
        warmup = min(warmup, steps)
        start = 2e-3 / max(warmup, 1)
        for at in sorted({0, warmup // 2, warmup, (warmup + steps) // 2, steps - 1}):
            if at <= warmup and warmup:
                expected = start + (2e-3 - start) * at / warmup
            else:
                share = min((at - warmup) / (max(steps, warmup + 1) - warmup), 1)
                expected = 2e-3 * (0.1 + 0.9 * 0.5 * (1 + np.cos(np.pi * share)))
            assert float(rate(at)) == pytest.approx(expected, rel=1e-5)
        assert float(rate(0)) > 0, "no step is lost"

    def test_or_by_an_exponential(self):
        """Point-NeRF's: a tenth after half a million of a million steps."""
        o = OptimizerConfig(lr_generator=5e-4, warmup_steps=0, final_lr_scale=0.01, decay="exponential")
        rate = optimisation.learning_rate(dataclasses.replace(CONFIG, optimizer=o, num_steps=1_000_000))
        for at, expected in ((0, 5e-4), (500_000, 5e-5), (1_000_000, 5e-6)):
            assert float(rate(at)) == pytest.approx(expected, rel=1e-4)

    def test_the_algorithm_is_the_one_asked_for(self):
        gradient, updates = jnp.array([0.5, -2.0]), {}
        for name, algorithm in (("adam", optax.adam), ("radam", optax.radam)):
            config = dataclasses.replace(CONFIG, optimizer=dataclasses.replace(CONFIG.optimizer, algorithm=name))
            expected = algorithm(optimisation.learning_rate(config))
            ours, _ = optimisation.optimizers(config)
            updates[name], _ = ours.update(gradient, ours.init(gradient))
            close(updates[name], expected.update(gradient, expected.init(gradient))[0])
        assert (updates["adam"] != updates["radam"]).all()
