"""Mesh files read with their materials, and points on their surfaces."""
