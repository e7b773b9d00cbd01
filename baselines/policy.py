"""A trained policy as plain arrays: the actor evaluated in NumPy, without torch.

    a = clip(W_L φ(… φ(W_1 o + b_1) …) + b_L, −1, 1),      φ = ReLU

o is an observation of :mod:`slipcar.envs.observation`: `features` on one scenario; with the nearest
obstacles in the slots behind it for worlds that vary. This is the mean of the Gaussian that PPO
trains (docs/learning.md); sampling it needs `log_std` as well.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from slipcar.envs import Family, Scenario
from slipcar.envs.observation import Layout
from slipcar.envs.sources import Source

ACTION_DIM = 2

#: Rows given to one matrix product. BLAS rounds differently for different shapes, so a fixed
#: one makes the action for an observation independent of the batch it comes in, to the bit.
_ROWS = 16


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """The actor of a trained policy; `predict` has Stable-Baselines3's signature.

    Attributes:
        weights: one matrix a layer, (out, in) float32; the first takes an observation, the last
            gives the 2 actions.
        biases: one vector a layer, (out,) float32.
        log_std: logarithm of the exploration noise of each action, (2,) float32.
        trained_on: a scenario, or a family of them.
        training: how it was trained, as plain data: configuration, seed, seconds, versions, and
            `history`, the validation scores on the way.
        observation: which kind it must be given: `features`, `egocentric` or `state`.
        obstacle_slots: how many obstacles the observation must show.

    Raises:
        ValueError: for layers that do not fit together or the observation, non-finite numbers, or
            an unknown kind of observation.
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    log_std: np.ndarray
    trained_on: Source
    training: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    observation: str = "features"
    obstacle_slots: int = 0

    #: That it looks at the state.
    closed_loop: ClassVar[bool] = True

    def __repr__(self) -> str:
        sizes = " → ".join(map(str, self.sizes))
        world = "a family" if isinstance(self.trained_on, Family) else "a scenario"
        return f"Policy({self.observation}, {sizes}, trained on {world})"

    def __post_init__(self) -> None:
        if not self.weights or len(self.weights) != len(self.biases):
            raise ValueError(
                f"a policy needs as many weight matrices as biases and at least one, "
                f"not {len(self.weights)} and {len(self.biases)}"
            )
        if not isinstance(self.trained_on, (Scenario, Family)):
            raise ValueError(f"trained_on must be a Scenario or a Family, not {self.trained_on!r}")
        width = self.layout.size
        checked: dict[str, list[np.ndarray]] = {"weights": [], "biases": []}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            rows = len(weight) if np.ndim(weight) else 0
            out = ACTION_DIM if i == len(self.weights) - 1 else rows
            checked["weights"].append(_parameter(f"weights[{i}]", weight, (out, width)))
            checked["biases"].append(_parameter(f"biases[{i}]", bias, (out,)))
            width = out
        object.__setattr__(self, "weights", tuple(checked["weights"]))
        object.__setattr__(self, "biases", tuple(checked["biases"]))
        object.__setattr__(self, "log_std", _parameter("log_std", self.log_std, (ACTION_DIM,)))

    @property
    def layout(self) -> Layout:
        """What an observation consists of."""
        return Layout(self.observation, self.obstacle_slots)

    @property
    def scenario(self) -> Scenario:
        """The scenario it was trained on.

        Raises:
            ValueError: if that is a family: `trained_on` tells which.
        """
        if isinstance(self.trained_on, Family):
            raise ValueError(
                "this policy was trained on a family of worlds, not on one scenario: name the "
                "world that it is to drive in, such as family:random:0"
            )
        return self.trained_on

    def knows(self, scenario: Scenario) -> bool:
        """Whether it was trained on this scenario, or on a family that it may come from.

        That is: everything that all worlds of the family share is the same, and the number of
        obstacles, the slip and the horizon lie within its ranges. Where things lie is not asked.
        """
        family = self.trained_on
        if not isinstance(family, Family):
            return family == scenario
        varied = ("start", "goal", "horizon", "slip", "obstacles")
        common = scenario.replace(**{name: getattr(family.base, name) for name in varied})
        numbers = (
            (family.obstacles, len(scenario.obstacles)),
            (family.slip, scenario.slip[0]),
            (family.horizon, scenario.horizon),
        )
        within = all(ends[0] <= number <= ends[1] for ends, number in numbers)
        return bool(common == family.base and within)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Widths from the observation to the action, such as (12, 64, 64, 2)."""
        return (self.layout.size, *(len(bias) for bias in self.biases))

    @property
    def preparation_time(self) -> float:
        """Seconds of training."""
        return float(self.training.get("seconds", 0.0))

    def fingerprint(self) -> str:
        """Hexadecimal digest of everything the actions depend on."""
        digest = hashlib.sha256(repr((self.layout.entries, self.sizes)).encode())
        for array in (*self.weights, *self.biases, self.log_std):
            digest.update(np.ascontiguousarray(array, dtype="<f4").tobytes())
        return digest.hexdigest()[:16]

    @functools.cached_property
    def _layers(self) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        return tuple(
            (np.ascontiguousarray(weight.T, dtype=np.float64), bias.astype(np.float64))
            for weight, bias in zip(self.weights, self.biases, strict=True)
        )

    @functools.cached_property
    def _rng(self) -> np.random.Generator:
        return np.random.default_rng()

    def mean(self, observation: ArrayLike) -> np.ndarray:
        """Mean action before clipping, float64.

        Args:
            observation: (..., d), finite; d = 12 for `features` without slots.

        Returns:
            (..., 2); each row depends on its own observation alone, to the last bit.

        Raises:
            ValueError: for another length of the last axis or a non-finite entry.
        """
        size = self.sizes[0]
        observed = _checked_observation(observation, self.layout)
        batch = observed.shape[:-1]
        rows = observed.reshape(-1, size)
        padded = np.zeros((-(-len(rows) // _ROWS) * _ROWS, size))
        padded[: len(rows)] = rows
        hidden = padded.reshape(-1, _ROWS, size)
        *inner, (weight, bias) = self._layers
        for W, b in inner:
            hidden = hidden @ W
            hidden += b
            np.maximum(hidden, 0.0, out=hidden)
        out = hidden @ weight + bias
        return out.reshape(-1, ACTION_DIM)[: len(rows)].reshape(*batch, ACTION_DIM)

    def predict(
        self,
        observation: ArrayLike,
        state: Any = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Action for one observation or a batch.

        Args:
            observation: (d,) or (..., d), finite; d = 12 for `features` without slots.
            state: returned as it is: the policy has no memory.
            episode_start: ignored, for the same reason.
            deterministic: whether to return the mean; otherwise a sample around it, from a
                generator seeded by the system.

        Returns:
            Actions in [−1, 1], (2,) or (..., 2) float32, and `state`.

        Raises:
            ValueError: for another length of the last axis or a non-finite entry.
        """
        action = self.mean(observation)
        if not deterministic:
            action = action + np.exp(self.log_std) * self._rng.standard_normal(action.shape)
        return np.clip(action, -1.0, 1.0).astype(np.float32), state


def _parameter(name: str, value: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    array = np.array(value, dtype=np.float32)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite; {np.sum(~np.isfinite(array))} entries are not")
    array.setflags(write=False)
    return array


def _checked_observation(observation: ArrayLike, layout: Layout) -> np.ndarray:
    size, shown = layout.size, f" showing {layout.slots} obstacles" if layout.slots else ""
    try:
        observed = np.asarray(observation, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"an observation must be an array of {size} {layout.kind}{shown}, "
            f"not {type(observation).__name__}"
        ) from error
    if observed.ndim == 0 or observed.shape[-1] != size:
        raise ValueError(
            f"this policy needs {layout.kind!r} observations{shown}, {size} entries on the last "
            f"axis, not shape {observed.shape}"
        )
    if not np.isfinite(observed).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(observed))[0])
        raise ValueError(
            f"observation{list(index)} is {observed[index]}; observations must be finite"
        )
    return observed
