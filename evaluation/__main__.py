"""`python -m slipcar.evaluation` is the `slipcar` command."""

from slipcar.evaluation.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
