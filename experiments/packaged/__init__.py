"""The demo, and how the networks of the package are made."""
