"""The commands of `slipcar`, one a file; each a thin call of a documented function."""
