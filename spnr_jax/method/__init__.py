"""The method: a network that renders rays of an encoded cloud, and the handle that people use."""
