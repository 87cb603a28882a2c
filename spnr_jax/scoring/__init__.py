"""How good pictures are: metrics, intervals, tables and reports."""
