"""One file per table or figure; each is a command with --help, and writes pictures beside its numbers."""

from spnr_jax.devices import runtime

runtime.hide_false_alarms()  # before the modules of this package import JAX
