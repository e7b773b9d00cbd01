"""Random inputs against an independent judge: `make fuzz`, and a short version in the suite."""
