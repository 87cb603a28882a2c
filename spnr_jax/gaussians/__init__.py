"""Gaussian splats of an object: placed on its surface, coloured by its pictures, drawn and refined; pure functions."""
