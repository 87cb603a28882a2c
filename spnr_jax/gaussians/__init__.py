"""Gaussian splats of an object: placed on its surface, coloured by its pictures; pure functions."""
