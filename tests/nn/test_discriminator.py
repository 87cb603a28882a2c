"""Conditional PatchGAN."""

import jax
import jax.numpy as jnp
import numpy as np
from support import reference
from support.laws import close, numbers

from spnr_jax.nn.paper_layers import Discriminator

IMAGE, CONDITION = numbers(0, 2, 24, 24, 3), numbers(1, 2, 24, 24, 3)
MASK = numbers(2, 2, 24, 24) > 0
MODULE = Discriminator(width=4, num_groups=2)
VARIABLES = jax.jit(MODULE.init)(jax.random.key(0), IMAGE, CONDITION, MASK)
apply = jax.jit(MODULE.apply)


def test_is_the_layers_written_out():
    params = jax.tree.map(np.float64, VARIABLES["params"])
    logits = np.asarray(apply(VARIABLES, IMAGE, CONDITION, MASK))
    for i in range(2):
        y = np.concatenate([np.float64(x)[i] for x in (IMAGE, CONDITION, MASK[..., None])], axis=-1)
        for layer in range(5):
            y = reference.convolution(y, params[f"kernel_{layer}"], stride=2 if layer < 3 else 1)
            if layer in (0, 4):
                y = y + params[f"bias_{layer}"]
            else:
                norm = params[f"norm_{layer}"]
                y = reference.group_norm(y, 2, norm["scale"], norm["bias"])
            y = y if layer == 4 else np.where(y > 0, y, 0.2 * y)
        close(logits[i], y, atol=1e-4)


def test_condition_and_mask_change_its_mind_and_other_images_do_not():
    logits = apply(VARIABLES, IMAGE, CONDITION, MASK)
    assert (jnp.abs(apply(VARIABLES, IMAGE, 1 - CONDITION, MASK) - logits) > 1e-4).any()
    assert (jnp.abs(apply(VARIABLES, IMAGE, CONDITION, ~MASK) - logits) > 1e-4).any()
    other = jnp.concatenate([1 - IMAGE[:1], IMAGE[1:]])
    close(apply(VARIABLES, other, CONDITION, MASK)[1], logits[1])
