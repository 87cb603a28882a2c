"""How fast: beside a PyTorch twin, with growing work, and where data is made and read."""
