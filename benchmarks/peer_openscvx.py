"""OpenSCvx (successive convexification in JAX) on the car; run by :mod:`peers`.

Its own discretisation is a fine integration; to pose the same problem it is told to take one
Euler step an interval with the control held. The running cost is a sixth state to be minimised
at the end, as its documentation does, so costs are linearised whole and the trust region does
the rest. Weights, tolerance and Clarabel are the best found by trying a dozen combinations: its
defaults stop at a cost of 4.81, its default solver QOCO takes longer.
"""

from __future__ import annotations

import importlib.metadata
import os
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# As OpenSCvx itself sets it, but diffrax, imported below, must see it too.
os.environ["EQX_ON_ERROR"] = "nan"

import numpy as np
from peer_worker import Peer, serve

TOLERANCE = 1e-7
ALGORITHM = {"lam_cost": 1.0, "lam_prox": 1.0, "lam_vc": 10.0, "ep_tr": TOLERANCE, "k_max": 200}
#: Bounds that scale the states; none is active.
SCALES = {"position": 6.0, "heading": 4.0, "speed": 4.0, "turn": 4.0}


def build(problem: dict[str, Any]) -> Peer:
    """The symbolic problem, compiled."""
    import diffrax
    import openscvx as ox

    N, T = problem["nodes"], problem["horizon"]
    start, goal = np.array(problem["start"]), np.array(problem["goal"])
    guess, limit = np.array(problem["states"]), np.array(problem["control_bounds"])
    parts = (slice(0, 2), slice(2, 3), slice(3, 4), slice(4, 5))
    states = []
    for (name, scale), part in zip(SCALES.items(), parts, strict=True):
        size = part.stop - part.start
        state = ox.State(name, shape=(size,))
        state.min, state.max = -scale * np.ones(size), scale * np.ones(size)
        state.initial, state.final, state.guess = start[part], goal[part], guess[:, part]
        states.append(state)
    position, heading, speed, turn = states
    control = ox.Control("control", shape=(2,), parameterization="ZOH")
    control.min, control.max = -limit, limit
    control.guess = np.vstack([problem["controls"], problem["controls"][-1]])

    rate = ox.Sum(control * control)
    for cx, cy, radius in problem["obstacles"]:
        reach = radius + problem["clearance"]
        c = reach**2 - (position[0] - cx) ** 2 - (position[1] - cy) ** 2
        rate = rate + problem["obstacle_weight"] * ox.Max(0.0, c) ** 2
    cost = ox.State("cost", shape=(1,))
    cost.min, cost.max = np.zeros(1), np.full(1, 50.0)
    cost.initial, cost.final = np.zeros(1), [ox.Minimize(5.0)]
    cost.guess = np.linspace(0.0, 5.0, N)[:, None]

    solver = ox.Problem(
        dynamics={
            "position": ox.Concat(speed[0] * ox.Cos(heading[0]), speed[0] * ox.Sin(heading[0])),
            "heading": turn[0],
            "speed": control[0],
            "turn": control[1],
            "cost": rate,
        },
        constraints=[],
        states=[*states, cost],
        controls=[control],
        N=N,
        time=ox.Time(
            initial=0.0,
            final=T,
            min=0.0,
            max=T,
            uniform_time_grid=True,
            time_dilation_min=T * (1.0 - 1e-9),
            time_dilation_max=T * (1.0 + 1e-9),
        ),
        algorithm=ALGORITHM,
        discretizer={
            "dis_type": "ZOH",
            "ode_solver": "Euler",
            "diffrax_kwargs": {
                "num_substeps": 2,  # points, the first one included: one step
                "stepsize_controller": diffrax.ConstantStepSize(),
            },
        },
        solver={"cvx_solver": "CLARABEL", "solver_args": {}},
        float_dtype="float64",
    )
    solver.settings.dev.printing = False
    solver.initialize()

    def call() -> Any:
        solver.reset()
        return solver.solve()

    told = {
        "version": importlib.metadata.version("openscvx"),
        "tolerance": f"trust region {TOLERANCE:.0e}",
        "solves": "the problem",
    }
    return (
        told,
        call,
        lambda found: (
            np.asarray(found.nodes["control"])[:-1],
            solver.state.k - 1,
            found.converged,
        ),
    )


if __name__ == "__main__":
    serve(build)
