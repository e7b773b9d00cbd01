"""crocoddyl's FDDP on the car; run by :mod:`peers`.

FDDP knows no terminal condition and no bounds: the end is a quadratic penalty so stiff that the
cost agrees to five digits, and the bounds are not active at the optimum. The action model is
written in Python on plain numbers, about five times faster than on arrays of length 5, with
analytic derivatives and the Gauss-Newton Hessian of max(0, c)², which converges in fewer steps
here than the exact one. In C++ it would be faster still: most of the time is spent in it.
"""

from __future__ import annotations

from math import cos, sin
from typing import Any

import numpy as np
from peer_worker import Peer, serve

GOAL_WEIGHT, STOP, MAX_ITERATIONS = 1e6, 1e-9, 500


def build(problem: dict[str, Any]) -> Peer:
    """The shooting problem and its solver."""
    import crocoddyl

    dt, goal = problem["dt"], np.array(problem["goal"])
    weight = dt * problem["obstacle_weight"]
    rings = [(x, y, (r + problem["clearance"]) ** 2) for x, y, r in problem["obstacles"]]

    class Car(crocoddyl.ActionModelAbstract):
        """One interval; the obstacle cost of its first node is left out where that is the start."""

        def __init__(self, start: bool = False, end: bool = False) -> None:
            super().__init__(crocoddyl.StateVector(5), 0 if end else 2, 0)
            self.rings, self.end = [] if start else rings, end

        def createData(self) -> Any:  # noqa: N802
            data = crocoddyl.ActionDataAbstract(self)
            # What no state or control changes is written once.
            if self.end:
                data.Lxx[:] = 2.0 * GOAL_WEIGHT * np.eye(5)
            else:
                data.Fx[:] = np.eye(5)
                data.Fx[2, 4] = data.Fu[3, 0] = data.Fu[4, 1] = dt
                data.Luu[:] = 2.0 * dt * np.eye(2)
            return data

        def calc(self, data: Any, x: np.ndarray, u: np.ndarray | None = None) -> None:
            px, py, heading, speed, turn = x.tolist()
            cost = 0.0
            for cx, cy, reach in self.rings:
                c = reach - (px - cx) ** 2 - (py - cy) ** 2
                if c > 0.0:
                    cost += weight * c * c
            if self.end or u is None:
                data.xnext[:] = x
                if self.end:
                    cost += GOAL_WEIGHT * float((x - goal) @ (x - goal))
            else:
                a, b = u.tolist()
                cost += dt * (a * a + b * b)
                data.xnext[:] = (
                    px + dt * speed * cos(heading),
                    py + dt * speed * sin(heading),
                    heading + dt * turn,
                    speed + dt * a,
                    turn + dt * b,
                )
            data.cost = cost

        def calcDiff(self, data: Any, x: np.ndarray, u: np.ndarray | None = None) -> None:  # noqa: N802
            px, py, heading, speed, _ = x.tolist()
            gx = gy = hxx = hxy = hyy = 0.0
            for cx, cy, reach in self.rings:
                dx, dy = px - cx, py - cy
                c = reach - dx * dx - dy * dy
                if c > 0.0:
                    gx, gy = gx - 4.0 * weight * c * dx, gy - 4.0 * weight * c * dy
                    hxx += 8.0 * weight * dx * dx
                    hxy += 8.0 * weight * dx * dy
                    hyy += 8.0 * weight * dy * dy
            data.Lx[:] = (gx, gy, 0.0, 0.0, 0.0)
            if self.end:
                data.Lx += 2.0 * GOAL_WEIGHT * (x - goal)
                hxx, hyy = hxx + 2.0 * GOAL_WEIGHT, hyy + 2.0 * GOAL_WEIGHT
            elif u is not None:
                F, c, s = data.Fx, dt * cos(heading), dt * sin(heading)
                F[0, 2], F[0, 3], F[1, 2], F[1, 3] = -speed * s, c, speed * c, s
                data.Lu[:] = 2.0 * dt * u
            H = data.Lxx
            H[0, 0], H[0, 1], H[1, 0], H[1, 1] = hxx, hxy, hxy, hyy

    N = problem["nodes"]
    models = [Car(start=k == 0) for k in range(N - 1)]
    shooting = crocoddyl.ShootingProblem(np.array(problem["start"]), models, Car(end=True))
    solver = crocoddyl.SolverFDDP(shooting)
    solver.th_stop = STOP
    states = list(np.array(problem["states"]))
    controls = list(np.array(problem["controls"]))
    told = {
        "version": crocoddyl.__version__,
        "tolerance": f"gradient {STOP:.0e}",
        "solves": f"goal a penalty {GOAL_WEIGHT:.0e}‖x − x^f‖², no bounds; model in Python",
    }
    return (
        told,
        lambda: solver.solve(states, controls, MAX_ITERATIONS, False),
        lambda found: (np.array(solver.us), solver.iter, found),
    )


if __name__ == "__main__":
    serve(build)
