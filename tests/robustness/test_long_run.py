"""A long training watched from within: memory, handles and pace stay what they are, and nothing is compiled again.

    make long-run       2,000 steps of `tiny`, with a table

What is resident is read after a preview, its memory given back, from 5 % of the steps on: a training reaches its size
in its first epoch.  The laws are of one stretch, in which one program makes every step.
"""

import dataclasses
import os
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest
from support import tiny_dataset
from support.tiny_baselines import SHRUNKEN

from spnr_jax import presets
from spnr_jax.training import checkpoint, trainer

STEPS = int(os.environ.get("LONG_RUN_STEPS", "0"))
COMPILED = "/jax/core/compile/backend_compile_duration"  # JAX's name of the event
PHASES = ((trainer, "take_step"), (trainer.MetricsLog, "write"), (trainer, "preview"), (checkpoint, "save"))
SMALL = SHRUNKEN["points2nerf_tiny"]  # no convolutions: compiles in a second
QUICK = dataclasses.replace(SMALL, batch_objects=2, model=dataclasses.replace(SMALL.model, hidden_width=6))


class Witness:
    """What a training does to its process: what it holds after each preview, its pace, and what each phase compiles."""

    def __init__(self):
        self.phases, self.samples, self.pace, self.compiled = [], [], [], []

    def watch(self, patch, place, name):
        """Notes the phase of a function of the loop, and what its rows say."""
        work = getattr(place, name)

        def call(*arguments, **options):
            self.phases.append(name)
            row = arguments[1] if name == "write" else {}
            if "ms_per_step" in row:
                self.pace.append((row["step"], row["ms_per_step"]))
            if "val_psnr" in row:  # the preview's memory was given back
                self.samples.append((row["step"], *holdings()))
            return work(*arguments, **options)

        patch.setattr(place, name, call)

    def note(self, event, duration_secs, **names):
        if event == COMPILED and self.phases:
            done = Counter(self.phases)
            self.compiled.append((self.phases[-1], done[self.phases[-1]], done["take_step"]))


def holdings():
    """Megabytes of resident memory, threads and open files of this process."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmRSS"].split()[0]) / 1024, int(status["Threads"]), len(os.listdir("/proc/self/fd"))


def watch(config, run, dataset, **schedule):
    seen = Witness()
    jax.monitoring.register_event_duration_secs_listener(seen.note)
    try:
        with pytest.MonkeyPatch.context() as patch:
            for place, name in PHASES:
                seen.watch(patch, place, name)
            trainer.train(config, dataset, run, trainer.Schedule(**schedule))
    finally:
        jax.monitoring.unregister_event_duration_listener(seen.note)
    return seen


def again(seen):
    """Compilations after the first time of a kind of work."""
    return [one for one in seen.compiled if one[1] > 1 and one[2] > 1]


def drift(steps, values):
    """Rise of the line through the values (Theil and Sen) from the first to the last step, as a share of the median."""
    i, j = np.triu_indices(len(steps), 1)
    slope = np.median((values[j] - values[i]) / (steps[j] - steps[i]))
    return float(slope * (steps[-1] - steps[0]) / np.median(values))


@pytest.mark.ci
def test_each_kind_of_work_compiles_when_it_is_done_for_the_first_time_and_never_again(tmp_path):
    config = dataclasses.replace(QUICK, num_steps=24)
    seen = watch(config, tmp_path, tiny_dataset.dataset(), log_every=4, preview_every=8, checkpoint_every=8)
    assert {"take_step", "preview"} <= {phase for phase, _, _ in seen.compiled}
    assert not again(seen)
    assert [step for step, *_ in seen.samples] == [8, 16, 24], "read when the preview's memory was given back"


@pytest.mark.skipif(not STEPS, reason="`make long-run`: minutes on an idle machine")
def test_memory_handles_and_pace_of_a_long_run(tmp_path):
    """Memory grows by less than 1 %, a step's time by less than 5 %, threads and files by fewer than ten."""
    from data_gen.make.generate import generate
    from data_gen.plan.tasks import GenerateConfig
    from spnr_jax.formats import data_sets

    generate(GenerateConfig(out=tmp_path / "data", objects=48, spp=16, visibility_grid=2))
    tiny = presets.tiny()
    config = dataclasses.replace(tiny, num_steps=STEPS, loss=dataclasses.replace(tiny.loss, adversarial_weight=0.0))
    every = {"log_every": max(STEPS // 200, 1), "preview_every": max(STEPS // 80, 1)}
    dataset = data_sets.open_dataset(tmp_path / "data")
    seen = watch(config, tmp_path / "run", dataset, checkpoint_every=max(STEPS // 25, 1), **every)
    steps, memory, threads, files = np.array([row for row in seen.samples if row[0] >= STEPS / 20], float).T
    pace = np.array([row for row in seen.pace if row[0] >= STEPS / 20]).T
    handles = [float(kind[-3:].mean() - kind[:3].mean()) for kind in (threads, files)]
    print(f"\nmemory {drift(steps, memory):+.2%} of {np.median(memory):.0f} MB, threads and files {handles}", end="")
    print(f"; pace {drift(*pace):+.2%} of {np.median(pace[1]):.0f} ms a step", end="")
    assert drift(steps, memory) < 0.01
    assert drift(*pace) < 0.05
    assert max(handles) < 10
    assert not again(seen)
