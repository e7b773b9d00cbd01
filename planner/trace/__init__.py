"""Functions to expressions to kernels."""
