"""Where a program runs: the process on its machine, and the devices of JAX."""
