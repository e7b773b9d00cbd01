"""Figures of plans, comparisons and suites. They need matplotlib; nothing else here does."""
