"""Linear-quadratic problems."""
