"""Pure functions of arrays, and the records that travel between them."""
