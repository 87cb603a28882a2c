"""Where a program runs: the devices and what lies where on them, workers, memory, kept programs."""
