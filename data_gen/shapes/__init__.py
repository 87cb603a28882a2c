"""Shapes, outlines, patterns and finishes that procedural objects are made of."""
