"""A run folder of an untrained network, made in a second: for what asks whether it runs, not how good it is."""

import functools

from spnr_jax.scoring import evaluation
from spnr_jax.training import checkpoint, optimisation
from support import tiny_dataset

CONFIG = tiny_dataset.PLAIN


@functools.cache
def run():
    """The folder, removed at the end of the session."""
    folder = tiny_dataset.folder() / "untrained"
    checkpoint.write_config(folder, CONFIG)
    checkpoint.save(folder, optimisation.jitted_create_state(CONFIG))
    return folder


@functools.cache
def evaluated() -> evaluation.Evaluation:
    """Its scores on the test split."""
    return evaluation.evaluate(run(), tiny_dataset.dataset(), say=lambda line: None)
