"""How fast the paper's network is, beside a PyTorch twin."""
