"""A policy as ONNX or TorchScript: from time and state to the control, observation included.

    u = scale · clip(network(observation(t, x)), −1, 1)

The numbers of one world (goal, horizon, obstacles, slip, bounds) are constants of the file, so a
runtime needs to know nothing of slipcar: it hands over what it measures and gets what it plays.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from slipcar.baselines.policy import Policy
from slipcar.envs import Scenario
from slipcar.envs.arrays import tensor_functions
from slipcar.envs.observation import entries, observe
from slipcar.envs.parameters import Parameters
from slipcar.envs.transition import proximity

#: What a policy can be written as, and the ending of such a file.
TARGETS = {"onnx": ".onnx", "torchscript": ".pt"}
#: Largest difference from the original that an export may have, by its precision, per unit of u.
TOLERANCE = {False: 1e-6, True: 1e-4}
_OPSET = 17


class Deployed(torch.nn.Module):
    """t (batch,) [s] and x (batch, 5) -> u (batch, 2), in physical units."""

    def __init__(self, policy: Policy, scenario: Scenario, dtype: torch.dtype) -> None:
        super().__init__()
        self._layout = policy.layout
        self._numbers = Parameters.like(torch.zeros(1, dtype=dtype), scenario)
        self._weights = [torch.tensor(weight.T, dtype=dtype) for weight in policy.weights]
        self._biases = [torch.tensor(bias, dtype=dtype) for bias in policy.biases]
        self._scale = torch.tensor(scenario.action_scale, dtype=dtype)

    def forward(self, t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """The control."""
        layout, functions = self._layout, tensor_functions()
        states = [x[:, i] for i in range(5)]
        rims = proximity(self._numbers, states, functions)[2] if layout.slots else []
        told, _ = entries(layout, self._numbers, t, states, rims, functions)
        columns = [entry + torch.zeros_like(t) for entry in told]
        missing = [torch.zeros_like(t)] * (layout.size - len(columns))
        # Observations are float32, whatever the rest is computed in.
        hidden = torch.stack(columns + missing, dim=1).to(torch.float32).to(x.dtype)
        *inner, (weight, bias) = zip(self._weights, self._biases, strict=True)
        for W, b in inner:
            hidden = torch.relu(hidden @ W + b)
        return torch.clamp(hidden @ weight + bias, -1.0, 1.0) * self._scale


def export_policy(
    policy: Policy, path: Path, target: str, scenario: Scenario | None = None, *,
    float32: bool = False,
) -> float | None:  # fmt: skip
    """Write a policy for one world, and compare what is written with the original.

    Args:
        policy: what to write.
        path: the file.
        target: one of :data:`TARGETS`.
        scenario: the world; None is the one that the policy was trained on.
        float32: inputs, outputs and everything between in single precision instead of double.

    Returns:
        The largest difference from the original at 1000 states, per unit of the largest control;
        None where onnxruntime is not installed to tell.

    Raises:
        ValueError: for an unknown target, a policy of a family without a scenario, a scenario
            without control bounds, or a file that differs by more than rounding.
        OSError: if the file cannot be written.
        ImportError: if `onnx` is needed and not installed.
    """
    if target not in TARGETS:
        raise ValueError(f"unknown target {target!r}; a policy is exported as {list(TARGETS)}")
    if path.is_dir() or not path.parent.is_dir():
        raise OSError(f"cannot write {path}: it must be a file in a folder that is there")
    world = policy.scenario if scenario is None else scenario
    dtype = torch.float32 if float32 else torch.float64
    module = Deployed(policy, world, dtype)
    t, x = (torch.tensor(a[:2], dtype=dtype) for a in _cases(world))
    about = json.dumps(
        {
            "slipcar": 1,
            "fingerprint": policy.fingerprint(),
            "scenario": world.to_dict(),
            "observation": list(policy.layout.entries),
        }
    )
    with warnings.catch_warnings():
        # Of branches on sizes, which the world fixes, and of the exporter's own age.
        warnings.simplefilter("ignore")
        if target == "onnx":
            _write_onnx(module, (t, x), path, about)
        else:
            traced = torch.jit.trace(module, (t, x))
            torch.jit.save(traced, str(path), _extra_files={"slipcar.json": about.encode()})
    off = _difference(policy, world, path, target, float32=float32)
    if off is not None and not off <= TOLERANCE[float32]:
        path.unlink()
        raise ValueError(
            f"{path} would differ from the policy by {off:.3g} of the largest control, more than "
            f"{TOLERANCE[float32]:g}"
        )
    return off


def _write_onnx(module: Deployed, inputs: tuple[Any, ...], path: Path, about: str) -> None:
    try:
        import onnx
    except ImportError as error:
        raise ImportError('ONNX files need onnx: pip install "slipcar[export]"') from error
    torch.onnx.export(
        module, inputs, str(path), dynamo=False, opset_version=_OPSET,
        input_names=["t", "x"], output_names=["u"],
        dynamic_axes={name: {0: "batch"} for name in ("t", "x", "u")},
    )  # fmt: skip
    written = onnx.load(path)
    onnx.helper.set_model_props(written, {"slipcar": about})
    onnx.checker.check_model(written)
    onnx.save(written, path)


def _cases(scenario: Scenario, count: int = 1000) -> tuple[np.ndarray, np.ndarray]:
    """Times (count,) and states (count, 5) all over the world."""
    rng = np.random.default_rng(0)
    t = scenario.horizon * rng.random(count)
    between = scenario.start + rng.random((count, 1)) * (scenario.goal - scenario.start)
    return t, between + rng.standard_normal((count, 5))


def _difference(
    policy: Policy, world: Scenario, path: Path, target: str, *, float32: bool
) -> float | None:
    t, x = _cases(world)
    if float32:
        t, x = (a.astype(np.float32).astype(np.float64) for a in (t, x))
    seen = observe(world, policy.observation, t, x, policy.obstacle_slots)
    expected = policy.predict(seen)[0] * world.action_scale
    real = np.float32 if float32 else np.float64
    given = t.astype(real), x.astype(real)
    if target == "onnx":
        try:
            import onnxruntime
        except ImportError:
            return None
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        got = session.run(None, dict(zip(("t", "x"), given, strict=True)))[0]
    else:
        got = torch.jit.load(str(path))(*map(torch.from_numpy, given)).numpy()
    return float((np.abs(got - expected) / world.action_scale).max())
