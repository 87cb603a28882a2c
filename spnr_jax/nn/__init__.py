"""Networks as Linen modules, without sampling and losses."""
