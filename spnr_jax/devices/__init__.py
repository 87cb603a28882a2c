"""Where a program runs: the devices and what lies where on them, the allocator, the start of a process."""
