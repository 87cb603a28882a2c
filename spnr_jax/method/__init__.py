"""The two methods, ours and the paper's, and the handle to load, encode and render with."""
