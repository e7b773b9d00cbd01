"""One fresh process of :mod:`cold`: import, plan twice, tell the times as JSON."""

import importlib.util
import json
import sys
import time
from collections.abc import Callable
from typing import Any


def main(case: str) -> None:
    began = time.perf_counter()
    if case == "nothing":
        print(json.dumps({}))
        return
    if case in ("numba", "numpy"):
        if case == "numpy":
            sys.modules["numba"] = None  # type: ignore[assignment]  # importing it now fails
        elif importlib.util.find_spec("numba") is None:
            raise ModuleNotFoundError("numba is not installed")
        from slipcar.envs import Scenario
        from slipcar.planner import plan

        imported = time.perf_counter()

        def first() -> Callable[[], Any]:
            scenario = Scenario.named("paper")
            return lambda: plan(scenario)
    else:
        import casadi_nlp

        from slipcar.envs import Scenario

        imported = time.perf_counter()

        def first() -> Callable[[], Any]:
            return casadi_nlp.WholeNlp(Scenario.named("paper"), case).solve

    call = first()
    call()
    planned = time.perf_counter()
    call()
    again = time.perf_counter()
    print(
        json.dumps(
            {"import": imported - began, "first": planned - imported, "second": again - planned}
        )
    )


if __name__ == "__main__":
    main(sys.argv[1])
