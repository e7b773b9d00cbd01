"""The same rows in many worlds: held-out random ones, from dry to slippery, few and many nodes."""
