"""Networks: one Linen module a file, no sampling and no loss inside."""
