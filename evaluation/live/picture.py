"""One picture: a plan, its uncertainty, noisy paths, and the numbers beside it."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from slipcar.envs import Scenario
from slipcar.evaluation.live.cloud import PATHS, cloud, violated
from slipcar.evaluation.live.policies import driven_by
from slipcar.evaluation.live.request import Request, plane_of
from slipcar.planner import Feedback, OpenLoop, Plan, plan
from slipcar.planner.search.risk import wilson_interval

#: Fresh paths that verify a risk on the page; `slipcar plan --risk` takes 100 000.
EPISODES = 20_000
_QUICK = {"starts": 1, "max_iterations": 60}
#: Ellipses drawn, at most.
_ELLIPSES = 14


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """What goes to the page: numbers and words, and arrays of the plane.

    Attributes:
        facts: plain data.
        arrays: by name, float32 and of any shape.
    """

    facts: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]

    def to_bytes(self, number: int) -> bytes:
        """The answer to request `number`: length of the header, header in JSON, arrays in a row."""
        arrays = {name: np.ascontiguousarray(a, dtype="<f4") for name, a in self.arrays.items()}
        shapes = [[name, list(a.shape)] for name, a in arrays.items()]
        header = json.dumps({"id": number, **self.facts, "arrays": shapes}).encode()
        header += b" " * (-len(header) % 4)  # float32 begins at a multiple of four
        parts = [len(header).to_bytes(4, "little"), header]
        return b"".join(parts + [a.tobytes() for a in arrays.values()])


def options_of(request: Request) -> dict[str, Any]:
    """What `plan` is called with; the page shows it as Python."""
    price = {"risk_price": request.price} if request.price else {}
    if request.mode == "risk" and request.verify:
        return {"feedback": True, "risk": request.risk, "risk_episodes": EPISODES}
    if request.mode == "open":
        options: dict[str, Any] = price or {"expected": True}
    else:
        options = {"feedback": True, **price}
    return {**options, **(_QUICK if request.quick else {})}


def picture(request: Request, problem: Any) -> Picture:
    """Plan for a problem and draw noisy paths of the plan, and of a policy beside it.

    Raises:
        ValueError: if the planner refuses the problem.
    """
    began = time.perf_counter()
    planned = plan(problem, **options_of(request))
    planned_in = time.perf_counter() - began
    plane = list(plane_of(problem))
    played: OpenLoop = OpenLoop(planned) if request.mode == "open" else Feedback(planned)
    facts, arrays = drawn(problem, played.control, plane)
    arrays |= {
        "mean": planned.mean[:, plane],
        "ellipses": ellipses(planned.mean, planned.covariance, plane),
    }
    facts |= numbers(planned) | {"plan_ms": 1e3 * planned_in, "quick": request.quick}
    facts["python"] = python(request, problem)
    if request.policy and isinstance(problem, Scenario):
        beside, learned = drawn(problem, driven_by(request.policy, problem), plane)
        facts["policy"] = {"name": request.policy, **beside}
        arrays["policy"] = learned["cloud"]
    facts["total_ms"] = 1e3 * (time.perf_counter() - began)
    return Picture(facts, arrays)


def drawn(problem: Any, control: Any, plane: list[int]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Noisy paths in the plane, and how many of them collide."""
    states = cloud(problem, control)
    broken = violated(problem, states)
    arrays = {"cloud": states[:, :, plane]}
    if broken is None:
        return {"hits": None}, arrays
    hits = int(broken.sum())
    arrays["broken"] = broken
    return {"hits": hits, "paths": PATHS, "interval": list(wilson_interval(hits, PATHS))}, arrays


def numbers(planned: Plan) -> dict[str, Any]:
    """What is said of a plan beside its picture."""
    expected, risk = planned.expected, planned.risk
    found: dict[str, Any] = {
        "ok": planned.status.ok,
        "status": str(planned.status.value),
        "message": planned.message,
        "iterations": planned.iterations,
        "cost": {"effort": planned.effort, "obstacles": planned.obstacle_cost},
        "predicted": None,
        "verified": None,
    }
    if expected is not None:
        found["cost"] = {
            "effort": expected.effort, "corrections": expected.feedback,
            "running": expected.running, "obstacles": expected.penalty, "goal": expected.goal,
        }  # fmt: skip
        found["predicted"] = expected.risk if hasattr(planned.problem, "constraint") else None
    if risk is not None:
        found["verified"] = {
            "rate": risk.verified, "interval": list(risk.interval), "episodes": risk.episodes,
            "requested": risk.requested, "reached": bool(risk.reached), "price": risk.price,
            "seconds": risk.simulation_time,
        }  # fmt: skip
    return found


def ellipses(mean: np.ndarray, covariance: Any, plane: list[int]) -> np.ndarray:
    """Rows x, y, semi-axes and angle [rad] of 95 % ellipses at some nodes, (k, 5)."""
    nodes = np.unique(np.linspace(1, len(mean) - 1, _ELLIPSES).astype(int))
    S = covariance[nodes][:, plane][:, :, plane]
    if not np.isfinite(S).all():
        return np.empty((0, 5))
    values, vectors = np.linalg.eigh(S)
    # χ² of two degrees of freedom: P(r² ≤ −2 log 0.05) = 95 %.
    axes = np.sqrt(-2.0 * np.log(0.05) * np.maximum(values, 0.0))
    angle = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
    return np.column_stack([mean[nodes][:, plane], axes[:, 1], axes[:, 0], angle])


def python(request: Request, problem: Any) -> str:
    """The plan's call, to be copied."""
    arguments = "".join(f", {name}={value!r}" for name, value in options_of(request).items())
    call = f"p = plan(s{arguments})\nprint(p)\n"
    if not isinstance(problem, Scenario):
        return f"from slipcar.planner import plan\n\ns = ...  # your {request.system}\n{call}"
    return (
        "from slipcar.envs import Scenario\nfrom slipcar.planner import plan\n\n"
        f"s = Scenario.from_json({problem.to_json()!r})\n{call}"
    )
