"""From batches to a trained network: losses, steps, checkpoints, the loop."""
