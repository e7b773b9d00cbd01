"""Covariance, belief and losses."""
