"""The preset `tiny` shrunken to the painted data set, for experiments that train several variants of it."""

import dataclasses

from support import tiny_dataset

L1_ONLY = dataclasses.replace(
    tiny_dataset.CONFIG, loss=dataclasses.replace(tiny_dataset.CONFIG.loss, adversarial_weight=0.0)
)
