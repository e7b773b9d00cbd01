"""One fresh process of :mod:`cold`: import, do something twice, tell the times as JSON."""

import importlib
import json
import sys
import time
from collections.abc import Callable
from typing import Any

#: Seconds of Monte Carlo in the first call, where there was some.
Told = dict[str, float]


def main(case: str) -> None:
    if case == "nothing":
        print(json.dumps({}))
        return
    kind, _, count = case.partition(":")
    if kind == "numpy":
        sys.modules["llvmlite"] = None  # type: ignore[assignment]  # importing it now fails
    began = time.perf_counter()
    setup = {"fatrop": _casadi, "ipopt": _casadi, "pendulums": _pendulums}.get(kind, _slipcar)
    make = setup(kind, count)
    imported = time.perf_counter()
    call = make()
    if kind == "pendulums":  # the process has planned before: what follows is the new kind alone
        imported = time.perf_counter()
    simulated = getattr(getattr(call(), "risk", None), "simulation_time", None)
    planned = time.perf_counter()
    call()
    again = time.perf_counter()
    told: Told = {
        "import": imported - began,
        "first": planned - imported,
        "second": again - planned,
    }
    print(json.dumps(told if simulated is None else {**told, "Monte Carlo": simulated}))


def _slipcar(kind: str, _: str) -> Callable[[], Callable[[], Any]]:
    """Planning for the paper's case; with a risk; or driving it, a plan at every step."""
    from slipcar.envs import Scenario
    from slipcar.planner import plan

    if kind == "plan":
        importlib.import_module("llvmlite")  # its absence is noticed here
    if kind == "receding":
        return lambda: _episode(Scenario.named("paper"))

    def make() -> Callable[[], Any]:
        scenario = Scenario.named("paper")
        options: dict[str, Any] = {"risk": 0.01} if kind == "risk" else {}
        return lambda: plan(scenario, **options)

    return make


def _episode(scenario: Any) -> Callable[[], Any]:
    """An episode of a new controller in the environment."""
    import gymnasium as gym

    from slipcar.planner import RecedingHorizon

    env = gym.make("slipcar.envs:SlipCar-v0", scenario=scenario, observation="state")

    def drive() -> None:
        controller, state, done = RecedingHorizon(scenario), None, False
        observation, _ = env.reset(seed=0)
        while not done:
            action, state = controller.predict(observation, state)
            observation, _, done, _, _ = env.step(action)

    return drive


def _casadi(solver: str, _: str) -> Callable[[], Callable[[], Any]]:
    """Building CasADi's programme and solving it."""
    import casadi_nlp

    from slipcar.envs import Scenario

    return lambda: casadi_nlp.WholeNlp(Scenario.named("paper"), solver).solve


def _pendulums(_: str, count: str) -> Callable[[], Callable[[], Any]]:
    """A kind of problem that this process has not met, after another one."""
    from own_problems import Pendulums

    from slipcar.envs import Scenario
    from slipcar.planner import plan

    importlib.import_module("llvmlite")  # its absence is noticed here

    def make() -> Callable[[], Any]:
        plan(Scenario.named("paper"))
        problem = Pendulums(int(count))
        return lambda: plan(problem)

    return make


if __name__ == "__main__":
    main(sys.argv[1])
