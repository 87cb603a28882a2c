"""Renderers to compare with; each is pure functions over the project's records."""
