"""What is not a controller yet, made one: functions of (t, x), networks, callables of observations.

    StateFunction    u = f(t, x),     SI units      action = u / bounds, clipped to [−1, 1]
    ActionFunction   a = f(o),        in [−1, 1]    o: features, state or egocentric

:func:`slipcar.evaluation.own.as_controller.as_controller` says which of them an object needs.
"""

from __future__ import annotations

import dataclasses
import hashlib
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.envs import observation as layouts
from slipcar.envs.scenario import Scenario
from slipcar.envs.torch_backend import dtype_of_network
from slipcar.evaluation.noise import BLOCK
from slipcar.evaluation.own.digest import behaviour_digest

__all__ = ["ActionFunction", "StateFunction", "is_agent", "is_module", "per_row"]

Array = np.ndarray

#: Cars at once of a function of one state: no more are driven than are asked for, but for these.
_FEW = 16


def per_row(function: Callable[..., Any]) -> Callable[..., Any]:
    """Mark a function of (t, x) as one of a single state: x (5,) -> u (2,)."""
    function.per_row = True  # type: ignore[attr-defined]
    return function


@dataclasses.dataclass(frozen=True)
class StateFunction:
    """A function of time and state as a controller: u = f(t, x).

    Attributes:
        function: (t [s], x (rows, 5)) -> u (rows, 2) or (2,) for all, in m/s² and rad/s²; t is one
            number: rows of different times are handed over apart. θ is unwrapped. Whatever is
            beyond the scenario's control bounds is clipped.
        scenario: where it drives; its bounds scale the actions.
        per_row: whether it is a function of one state instead, x (5,) -> u (2,); slower.
        name: what errors call it.
    """

    function: Callable[..., Any]
    scenario: Scenario
    per_row: bool = False
    name: str = "controller"

    observation = "state"
    obstacle_slots = 0
    closed_loop = True

    @property
    def rows(self) -> int:
        """Cars that `predict` is given at once: the function's `rows`, else few if one by one."""
        return int(getattr(self.function, "rows", _FEW if self.per_row else BLOCK))

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Array | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, Any]:
        """Actions for observations (6,) or (rows, 6) of (x, t): (2,) or (rows, 2), and `state`.

        Raises:
            ValueError: if the function does not give finite controls of the right shape.
        """
        observed = np.asarray(observation, dtype=np.float64)
        rows = observed.reshape(-1, observed.shape[-1])
        # Observations are float32: the time of a node comes back rounded.
        nodes = np.clip(np.rint(rows[:, 5] / self.scenario.dt), 0, self.scenario.nodes - 1)
        control = np.empty((len(rows), 2))
        for k in np.unique(nodes).astype(int):
            here = nodes == k
            control[here] = self.control(float(self.scenario.times[k]), rows[here, :5])
        action = self.scenario.encode_control(control).reshape(*observed.shape[:-1], 2)
        return action, state

    def control(self, t: float, x: Array) -> Array:
        """Controls at time t [s] and states x (rows, 5): (rows, 2) [m/s², rad/s²], checked."""
        if self.per_row:
            return np.stack([self._checked(self._called(t, row), t, (2,)) for row in x])
        return self._checked(self._called(t, x), t, (len(x), 2))

    def fingerprint(self) -> str | None:
        """Digest of code, closure and all that the function refers to; None if that is unknown."""
        told = behaviour_digest(self.function)
        if told is None:
            return None
        text = f"{told}, {self.per_row}, {self.scenario.action_scale.tolist()}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _called(self, t: float, x: Array) -> Any:
        try:
            return self.function(t, x)
        except ValueError as error:
            if "truth value of an array" in str(error) and not self.per_row:
                raise ValueError(
                    f"{self.name}(t, x) is given {len(x)} states at once, x (rows, 5), and asks "
                    f"whether an array of them is true: use numpy.where, or mark it with "
                    f"slipcar.evaluation.own.per_row to be called for one state at a time"
                ) from error
            raise

    def _checked(self, answer: Any, t: float, shape: tuple[int, ...]) -> Array:
        given = "x (5,)" if self.per_row else f"x ({shape[0]}, 5)"
        where = f"{self.name}(t, x) at t = {t:g} s with {given}"
        u = _numbers(answer, where, "controls [m/s², rad/s²]")
        if u.shape not in (shape, (2,)):
            hint = ""
            if u.shape == shape[::-1]:
                hint = ": stack them on the last axis, numpy.stack([a_v, a_omega], axis=-1)"
            allowed = f"{shape}" if shape == (2,) else f"{shape}, or (2,) for all,"
            raise ValueError(f"{where} must return shape {allowed} not {u.shape}{hint}")
        if not np.isfinite(u).all():
            raise ValueError(f"{where} returned {u[~np.isfinite(u)][0]}; controls must be finite")
        return u


@dataclasses.dataclass(frozen=True)
class ActionFunction:
    """A function of the observation as a controller, a network or not: a = f(o).

    Networks of torch are evaluated without gradients, on the device and in the dtype of their own
    parameters, and in evaluation mode. Agents in CleanRL's manner give their mean action:
    `actor_mean(o)`, or the third of what `get_action(o)` returns (SAC). One that has
    `get_action_and_value` alone is sampled, with noise that depends on nothing but what it is
    shown, so that the same paths give the same numbers.

    Attributes:
        function: o (rows, d) float32 -> actions (rows, 2), clipped to [−1, 1] by the evaluation.
        observation: what it is shown: `features`, `state` or `egocentric`.
        obstacle_slots: how many obstacles besides.
        name: what errors call it.
    """

    function: Any
    observation: str = "features"
    obstacle_slots: int = 0
    name: str = "controller"

    closed_loop = True

    def predict(
        self,
        observation: Array,
        state: Any = None,
        episode_start: Array | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, Any]:
        """Actions for observations (d,) or (rows, d): (2,) or (rows, 2), and `state`.

        Raises:
            ValueError: if the function does not give actions of the right shape.
        """
        observed = np.asarray(observation, dtype=np.float32)
        rows = observed.reshape(-1, observed.shape[-1])
        answer = self._torch(rows) if is_agent(self.function) else self.function(rows)
        action = self._checked(answer, len(rows))
        return action.reshape(*observed.shape[:-1], 2), state

    def fingerprint(self) -> str | None:
        """Digest of code, weights and all that the function refers to; None if that is unknown."""
        told = behaviour_digest(self.function)
        if told is None:
            return None
        text = f"{told}, {self.observation}, {self.obstacle_slots}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _torch(self, rows: Array) -> Any:
        import torch

        agent = self.function
        first = next(iter(agent.parameters()), None) if is_module(agent) else None
        shown = torch.from_numpy(np.ascontiguousarray(rows))
        if first is not None:
            shown = shown.to(first.device, dtype_of_network(agent))
        training = bool(getattr(agent, "training", False))
        if training:
            agent.eval()
        try:
            with torch.no_grad():
                return self._answered(agent, shown, rows)
        finally:
            if training:
                agent.train()

    def _answered(self, agent: Any, shown: Any, rows: Array) -> Any:
        if callable(getattr(agent, "actor_mean", None)):
            return agent.actor_mean(shown)
        sampled = getattr(agent, "get_action_and_value", None) or getattr(agent, "get_action", None)
        if sampled is None:
            return agent(shown)
        import torch

        seed = int.from_bytes(hashlib.sha256(rows.tobytes()).digest()[:7], "little")
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            answer = sampled(shown)
        alone = callable(getattr(agent, "get_action_and_value", None))
        if isinstance(answer, tuple):  # SAC: action, its log-probability, mean action
            return answer[0] if alone or len(answer) < 3 else answer[2]
        return answer

    def _checked(self, answer: Any, rows: int) -> Array:
        where = f"{self.name}(observation) with observations ({rows}, {self._size})"
        if isinstance(answer, tuple):
            raise ValueError(
                f"{where} must return the actions alone, not a tuple of {len(answer)}; an object "
                f"with predict returns (actions, state)"
            )
        action = _numbers(answer, where, "actions in [-1, 1]")
        if action.dtype.kind != "f":
            raise ValueError(
                f"{where} returned {action.dtype} numbers: discrete actions, which the car has "
                f"not; actions are two real numbers in [-1, 1]"
            )
        if action.shape != (rows, 2):
            raise ValueError(f"{where} must return shape {(rows, 2)}, not {action.shape}")
        return action

    @property
    def _size(self) -> int:
        return layouts.Layout(self.observation, self.obstacle_slots).size


def is_module(thing: Any) -> bool:
    """Whether it is a network of torch."""
    torch = sys.modules.get("torch")  # without it there are no modules
    return torch is not None and isinstance(thing, torch.nn.Module)


def is_agent(thing: Any) -> bool:
    """Whether it is asked with tensors: a network of torch, or an agent in CleanRL's manner."""
    return is_module(thing) or callable(getattr(thing, "get_action_and_value", None))


def _numbers(answer: Any, where: str, what: str) -> Array:
    if hasattr(answer, "detach"):  # torch's
        answer = answer.detach().cpu().numpy()
    try:
        array = np.asarray(answer)
    except ValueError as error:
        raise ValueError(f"{where} must return an array of {what}: {error}") from error
    if array.dtype.kind not in "fiu":
        raise ValueError(
            f"{where} must return an array of {what}, not {article(type(answer).__name__)}"
        )
    return array


def article(word: str) -> str:
    """The word after its indefinite article."""
    return f"{'an' if word[:1].lower() in 'aeiou' else 'a'} {word}"
