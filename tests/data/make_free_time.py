"""Makes free_time.json: plans with free final time by an optimiser that shares nothing with ours.

    python tests/data/make_free_time.py          # needs casadi; seconds

The whole problem as one non-linear programme for IPOPT, the horizon T among its variables:

    min over T, x, u   Σ dt ‖u_k‖² + Σ dt λ Σ_o max(0, c_o(r_{k+1}))² + c T,      dt = T/(N−1)
    s.t.   x_{k+1} = x_k + dt b(x_k, u_k),   x_0 = start,   x_{N−1} = goal,   |u| ≤ bound

(paper §6.3; no noise, w = 0). Of the local optima found from several first T the file keeps the one
that the scenario's own guess leads to with T as the scenario has it; the others are listed. Each
is checked by the definitions of slipcar.envs, and by plans with T fixed on both sides of T*.

The same versions of CasADi and IPOPT on the same machine give the same file to the last digit.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from casadi_car import NX, bounds, stacked, stage_cost, step, unstacked, variables

from slipcar.envs import Scenario

TARGET = Path(__file__).with_name("free_time.json")
#: First values of T, as parts of the scenario's horizon: its own comes first.
FIRST = (1.0, 0.4, 0.7, 1.5, 2.5)
#: T is held at these parts of T* to see that it is a minimum.
NEIGHBOURS = (0.97, 0.99, 1.01, 1.03)
TOLERANCE = 1e-10

CASES: dict[str, tuple[Scenario, float]] = {
    "paper, time weight 0.25": (Scenario.named("paper"), 0.25),
    "paper, time weight 1": (Scenario.named("paper"), 1.0),
    "paper, time weight 4": (Scenario.named("paper"), 4.0),
    # Such haste that the bounds act; and the same without them.
    "paper, time weight 25": (Scenario.named("paper"), 25.0),
    "paper without control bounds, time weight 25": (
        Scenario.named("paper").replace(control_bounds=None),
        25.0,
    ),
    "random world 7, turned, time weight 1": (Scenario.random(seed=7, turned=True), 1.0),
}


class FreeTime:
    """The programme of one scenario; variables T, x_0, u_0, x_1, ..., multipliers as L = f + λᵀg.

    Args:
        scenario: what to plan for.
        time_weight: c.
    """

    def __init__(self, scenario: Scenario, time_weight: float) -> None:
        N = scenario.nodes
        # With dt = 1 these are the rates b and cost per second, which T then scales.
        unit = scenario.replace(horizon=float(N - 1))
        advance, price = step(unit), stage_cost(unit)
        xs, us, trajectory = variables(ca.MX, N)
        T = ca.MX.sym("T")
        dt = T / (N - 1)
        steps = [xs[k] + dt * (advance(xs[k], us[k]) - xs[k]) - xs[k + 1] for k in range(N - 1)]
        nlp = {
            "x": ca.vertcat(T, trajectory),
            "f": dt * sum(price(us[k], xs[k + 1]) for k in range(N - 1)) + time_weight * T,
            "g": ca.vertcat(*steps, xs[0] - scenario.start, xs[-1] - scenario.goal),
        }
        options = {
            "print_time": False,
            "expand": True,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.max_iter": 3000,
            "ipopt.tol": TOLERANCE,
            "ipopt.constr_viol_tol": TOLERANCE,
            "ipopt.dual_inf_tol": TOLERANCE,
            "ipopt.compl_inf_tol": TOLERANCE,
            "ipopt.acceptable_iter": 0,
            # IPOPT relaxes bounds by 1e-8, which would show in the controls that are on them.
            "ipopt.bound_relax_factor": 0.0,
        }
        self.scenario, self.time_weight = scenario, time_weight
        self._solver = ca.nlpsol("free_time", "ipopt", nlp, options)
        self._bound = bounds(scenario)

    def solve(self, T: float, beside: dict[str, Any] | None = None) -> dict[str, Any] | None:
        """From the scenario's guess stretched to T; or with T held, from a solution beside it.

        None if IPOPT fails.
        """
        if beside is None:
            states, controls = self.scenario.replace(horizon=T).initial_guess()
            low, high = 1e-2, np.inf
        else:
            states, controls, low, high = beside["states"], beside["controls"], T, T
        found = self._solver(
            x0=np.append(T, stacked(states, controls)),
            lbx=np.append(low, -self._bound),
            ubx=np.append(high, self._bound),
            lbg=0.0,
            ubg=0.0,
        )
        if not self._solver.stats()["success"]:
            return None
        flat, multipliers = (np.asarray(found[key]).ravel() for key in ("x", "lam_g"))
        states, controls = unstacked(flat[1:])
        return {
            "final_time": float(flat[0]),
            "cost": float(found["f"]) - self.time_weight * float(flat[0]),
            "states": states,
            "controls": controls,
            "adjoint": multipliers[: -2 * NX].reshape(-1, NX),
            "terminal_multiplier": multipliers[-NX:],
        }


def checked(scenario: Scenario, found: dict[str, Any]) -> None:
    """Compare with slipcar's own definitions of dynamics, costs and bounds."""
    timed = scenario.replace(horizon=found["final_time"])
    x, u, t = found["states"], found["controls"], timed.times
    moved = x[:-1] + timed.dt * timed.drift(t[:-1], x[:-1], u)
    cost = timed.dt * (timed.control_power(u).sum() + timed.obstacle_power(x[1:]).sum())
    np.testing.assert_allclose(moved, x[1:], atol=1e-9)
    np.testing.assert_allclose(x[[0, -1]], [timed.start, timed.goal], atol=1e-9)
    np.testing.assert_allclose(cost, found["cost"], rtol=1e-12)
    if timed.control_bounds is not None:
        assert (np.abs(u) <= timed.control_bounds).all()


def reference(scenario: Scenario, time_weight: float) -> dict[str, Any]:
    """One case of the file."""
    programme = FreeTime(scenario, time_weight)

    def total(found: dict[str, Any]) -> float:
        return found["cost"] + time_weight * found["final_time"]

    runs = [(part, programme.solve(part * scenario.horizon)) for part in FIRST]
    best = runs[0][1]
    if best is None:
        raise RuntimeError("IPOPT failed from the scenario's own guess")
    checked(scenario, best)
    beside = []
    for part in NEIGHBOURS:
        held = programme.solve(part * best["final_time"], beside=best)
        if held is None or total(held) <= total(best):
            raise RuntimeError(f"no minimum: T = {part} T* costs no more, or IPOPT failed")
        beside.append({"final_time": held["final_time"], "total": total(held)})
    return {
        "scenario": scenario.to_dict(),
        "time_weight": time_weight,
        "total": total(best),
        **{k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in best.items()},
        "neighbours_with_final_time_fixed": beside,
        "from_other_first_times": [
            {
                "first_time": part * scenario.horizon,
                "final_time": None if run is None else run["final_time"],
                "total": None if run is None else total(run),
            }
            for part, run in runs[1:]
        ],
    }


def ipopt_version() -> str:
    """From its header: CasADi does not tell."""
    header = Path(ca.GlobalOptions.getCasadiIncludePath()) / "coin-or" / "IpoptConfig.h"
    text = header.read_text(encoding="utf-8")
    return re.search(r'define IPOPT_VERSION "(.+?)"', text)[1]


def main() -> None:
    """Write the file and say what is in it."""
    cases = {}
    for name, (scenario, time_weight) in CASES.items():
        case = cases[name] = reference(scenario, time_weight)
        print(f"{name}: T* = {case['final_time']:.6f} s, cost {case['cost']:.8f}")
        for other in case["from_other_first_times"]:
            print("  from T = {first_time}: T* = {final_time}, total {total}".format(**other))
        held = [neighbour["total"] for neighbour in case["neighbours_with_final_time_fixed"]]
        print(f"  total {case['total']}, with T held beside T* {held}")
    data = {
        "made_by": "tests/data/make_free_time.py",
        "source": f"IPOPT {ipopt_version()} via CasADi {ca.__version__}, tol {TOLERANCE:g}",
        "multipliers": "gradients of a cost that is minimised: L = f + adjointᵀ(x_k + dt b_k − "
        "x_{k+1}) + terminal_multiplierᵀ(x_{N−1} − goal)",
        "cases": cases,
    }
    TARGET.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
