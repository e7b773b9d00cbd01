"""The maximum principle."""
