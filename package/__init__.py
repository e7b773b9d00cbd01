"""slipcar: plan, learn and compare for a car that slips, and for any stochastic system.

The parts are `slipcar.envs`, `slipcar.planner`, `slipcar.baselines` and `slipcar.evaluation`;
importing this imports none of them.
"""

#: The version that is installed.
__version__: str


def __getattr__(name: str) -> str:
    """`__version__`, read from the package's metadata when it is asked for."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    return version("slipcar")
