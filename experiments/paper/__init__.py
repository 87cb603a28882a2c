"""The paper's Table 1 and the supplement's figures: a file for each, run as `python -m experiments.paper.NAME`."""
