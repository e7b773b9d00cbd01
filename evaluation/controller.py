"""What can be evaluated: anything with the `predict` of Stable-Baselines3, and what it answers."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from slipcar.envs import observation as layouts
from slipcar.envs.scenario import Scenario
from slipcar.envs.validate import checked_int
from slipcar.evaluation.noise import BLOCK


@runtime_checkable
class Controller(Protocol):
    """What is evaluated: an object with the `predict` of Stable-Baselines3.

    Optional attributes:
        observation: `"features"` (default), `"state"` or `"egocentric"`: what `predict` is given.
        obstacle_slots: how many obstacles it is shown besides (default 0).
        closed_loop: whether it looks at the state (default True).
        preparation_time: seconds of planning or training (default unknown).
        failures: solves behind it that failed (default 0).
        fingerprint(): text that identifies its behaviour, so that a stored row can be reused.
        rows: how many episodes `predict` is given at once, a divisor of 1024 (default 1024).
            Always exactly that many, also when fewer episodes are asked for; a controller that
            is slow per row sets 1.
    """

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions in [−1, 1], (rows, 2), and the next hidden state.

        A state may have `failures` (rows,): solves that failed so far in each episode.
        """
        ...


def observation_layout(controller: Controller) -> layouts.Layout:
    """What `predict` is to be given: its `observation` and `obstacle_slots`, else what fits.

    Raises:
        ValueError: for an unknown kind, or a space that no observation fits.
    """
    named = getattr(controller, "observation", None)
    if isinstance(named, str):
        return layouts.Layout(named, getattr(controller, "obstacle_slots", 0))
    # A Stable-Baselines3 model says what it was trained on by its space alone.
    shape = getattr(getattr(controller, "observation_space", None), "shape", None)
    if shape is None:
        return layouts.Layout()
    try:
        return layouts.Layout.of_size(shape[0] if len(shape) == 1 else 0)
    except ValueError as error:
        raise ValueError(
            f"{controller_name(controller)} expects observations of shape {shape}: {error}"
        ) from None


def controller_name(controller: Any) -> str:
    """What an error calls it."""
    return type(controller).__name__


def check_controller(controller: Any) -> None:
    """Raises ValueError unless `controller` has a `predict` and sensible optional attributes."""
    if not callable(getattr(controller, "predict", None)):
        raise ValueError(
            f"a controller is an object with predict(observation, state, episode_start, "
            f"deterministic), which {controller!r} has not"
        )
    observation_layout(controller)
    rows = checked_int("rows", getattr(controller, "rows", BLOCK), at_least=1, at_most=BLOCK)
    if BLOCK % rows:
        raise ValueError(f"{controller_name(controller)}.rows must divide {BLOCK}, not {rows}")


def checked_answer(
    controller: Controller, scenario: Scenario, answer: Any, rows: int, k: int, first: int
) -> tuple[np.ndarray, Any]:
    """The action, float64 (rows, 2), and the hidden state that `predict` answered at step k.

    Raises:
        ValueError: naming the controller, what is wrong, the step and the episode.
    """
    name = controller_name(controller)
    where = f"at step {k} (t = {scenario.times[k]:.4g} s)"
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise ValueError(
            f"{name}.predict must return (action, state), not {type(answer).__name__} {where}"
        )
    try:
        action = np.asarray(answer[0], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}.predict returned no array of numbers {where}: {error}") from error
    if action.shape != (rows, 2):
        raise ValueError(
            f"{name}.predict must return actions of shape {(rows, 2)}, not {action.shape}, "
            f"{where}, episodes {first} to {first + rows - 1}"
        )
    if not np.isfinite(action).all():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(action))[0])
        raise ValueError(
            f"{name}.predict returned {action[row, column]} for action[{column}] {where}, "
            f"episode {first + row}; actions must be finite (they are clipped to [-1, 1])"
        )
    return action, answer[1]
