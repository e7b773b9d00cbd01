"""Random problems of the planner's class, each from a few plain numbers, which its repr tells.

A problem is posed in units where everything is of order one, and handed over in others: x' = X x,
u' = U u, t' = T t, cost' = C cost (as `benchmarks/systems/units.py` says).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import strategies as st

from . import drifts

Array = np.ndarray

#: How a path shall end. The last three cannot be met, those before can: a path is known that does.
MET = ("point", "some", "rows", "curved", "twice", "free")
UNMET = ("contradictory", "impossible", "far")
EXTRAS = (
    "penalty", "walls", "state_cost", "wavy_cost", "control_cost", "constraint",
    "terminal_weight", "start_covariance", "angles", "initial_guess", "given_jacobian",
)  # fmt: skip
NOISES = ("none", "constant", "certain", "huge", "state")
BOUNDS = ("none", "box", "loose", "tight", "tiny", "one-sided", "skew", "ball", "ball and box")


@dataclasses.dataclass(frozen=True)
class Kind:
    """The structure of a problem: what has to be compiled anew."""

    drift: str = "linear"
    states: int = 2
    controls: int = 1
    end: str = "point"
    noise: str = "none"
    extras: tuple[str, ...] = ()

    @property
    def linear(self) -> bool:
        """Whether what can be reached is convex, and the end asks for a point of a plane."""
        return self.drift in ("linear", "timed", "stiff") and self.end not in ("curved",)

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Kind:
        """One of many: the ordinary more often than the rest."""
        family = (drifts.SMOOTH, drifts.HARD, drifts.HOPELESS)[rng.choice(3, p=(0.65, 0.2, 0.15))]
        n, m = ((1, 1), (2, 1), (2, 2), (3, 1), (3, 2), (4, 2), (5, 3), (1, 2))[rng.integers(8)]
        extras = [name for name in EXTRAS if rng.random() < 0.15]
        return cls(
            drift=str(rng.choice(family)),
            states=n,
            controls=m,
            end=str(rng.choice(MET if rng.random() < 0.85 else UNMET)),
            noise=str(rng.choice(NOISES, p=(0.35, 0.25, 0.15, 0.1, 0.15))),
            extras=tuple(extras),
        )


@dataclasses.dataclass(frozen=True)
class Recipe:
    """All that a random problem follows from.

    Attributes:
        kind: its structure.
        seed: of its coefficients.
        intervals: K.
        grid: "even", "uneven" or "wild" (steps over three decades).
        bounds: one of `BOUNDS`.
        exponents: powers of ten of states, controls, time and cost in its units.
        spread: whether each state has a unit of its own, within 10^±3 of the rest.
    """

    kind: Kind = Kind()
    seed: int = 0
    intervals: int = 20
    grid: str = "even"
    bounds: str = "none"
    exponents: tuple[int, int, int, int] = (0, 0, 0, 0)
    spread: bool = False

    @property
    def plain(self) -> Recipe:
        """The same problem in units where everything is of order one."""
        return dataclasses.replace(self, exponents=(0, 0, 0, 0), spread=False)


class Own:
    """The problem that a recipe describes.

    Attributes:
        recipe: what it was made from.
        known: controls within bounds, (K, m), that lead (by Euler steps) where `terminal` asks,
            or None where there are none.
    """

    def __init__(self, recipe: Recipe) -> None:
        kind, rng = recipe.kind, np.random.default_rng(recipe.seed)
        n, m, K = kind.states, kind.controls, recipe.intervals
        self.recipe = recipe
        self._drift = drifts.drift(kind.drift, n, m, rng)
        self._rng = rng
        x_power, u_power, t_power, c_power = recipe.exponents
        apart = rng.uniform(-3.0, 3.0, size=n).round() * recipe.spread
        self.X, self.U = 10.0 ** (x_power + apart), 10.0**u_power
        self.T, self.C = 10.0**t_power, 10.0**c_power
        start, times = 0.5 * rng.normal(size=n), _grid(recipe.grid, K, rng)
        root = np.eye(m) + 0.3 * rng.normal(size=(m, m))
        lower, upper, radius = _bounds(recipe.bounds, m, rng)
        self.start, self.times = self.X * start, self.T * times
        self.control_weight = self.C / self.T / self.U**2 * (root @ root.T + 0.1 * np.eye(m))
        if np.isfinite(lower).any() or np.isfinite(upper).any():
            self.control_bounds = self.U * np.stack([lower, upper])
        if radius < np.inf:
            self.control_radius = self.U * radius
        wish = _waves(times, m, rng)
        wish = np.clip(wish, np.maximum(lower, -2.0), np.minimum(upper, 2.0))
        length = np.linalg.norm(wish, axis=1, keepdims=True)
        wish = wish * np.minimum(1.0, radius / np.maximum(length, 1e-300))
        path = self._rolled(start, times, wish)
        possible = np.isfinite(path).all() and np.abs(path).max() < 1e3
        self.known = self.U * wish if possible and kind.end in MET else None
        self._set_end(path[-1] if possible else start + rng.normal(size=n))
        self._set_noise(kind.noise)
        for name in kind.extras:
            getattr(self, f"_set_{name}")(path if possible else np.tile(start, (K + 1, 1)))

    def __repr__(self) -> str:
        return f"Own({self.recipe!r})"

    @property
    def cornered(self) -> bool:
        """Whether the known controls are all on their bounds.

        The end is a corner of what is reachable then, and no multipliers need exist.
        """
        if self.known is None or not hasattr(self, "control_bounds"):
            return False
        lower, upper = self.control_bounds
        return bool(((self.known == lower) | (self.known == upper)).all())

    def _rolled(self, x: Array, t: Array, u: Array) -> Array:
        path = [x]
        with np.errstate(all="ignore"):
            for k in range(len(u)):
                x = x + (t[k + 1] - t[k]) * self._drift(t[k], x, u[k])
                path.append(x)
        return np.array(path)

    def drift(self, t, x, u):
        return self._drift(np.asarray(t) / self.T, x / self.X, u / self.U) * (self.X / self.T)

    # ------------------------------------------------------------------ how it shall end

    def _set_end(self, goal: Array) -> None:
        n, kind, X = len(goal), self.recipe.kind.end, self.X
        q = 1 + int(self._rng.integers(n))
        G = self._rng.normal(size=(min(n, self.recipe.kind.controls + 1), n))
        far = goal + 1e3 * np.sign(self._rng.normal(size=n))
        asked = {
            "point": lambda x: x - goal,
            "some": lambda x: x[..., :q] - goal[:q],
            "rows": lambda x: (x - goal) @ G.T,
            "curved": lambda x: np.stack([np.sum(x * x, axis=-1) - goal @ goal], axis=-1),
            "twice": lambda x: np.concatenate([x - goal, 2.0 * (x - goal)], axis=-1),
            "free": lambda x: 0.0 * x[..., :1],
            "contradictory": lambda x: np.stack([x[..., 0], x[..., 0] - 1.0], axis=-1),
            "impossible": lambda x: x[..., :1] ** 2 + 1.0,
            "far": lambda x: x - far,
        }[kind]
        self.terminal = lambda x: asked(x / X)

    # ------------------------------------------------------------------ its noise

    def _set_noise(self, kind: str) -> None:
        n, X, T = self.recipe.kind.states, self.X[:, None], self.T
        shape = self._rng.normal(size=(n, 2))
        certain = np.zeros(n)
        certain[: max(1, n // 2)] = 1.0  # rows that are noisy

        def sigma(t, x):
            if kind == "state":
                return 0.1 * shape * x[..., :, None]
            if kind == "certain":
                rate = 1.0 + 0.5 * np.sin(np.asarray(t))[..., None, None]
                return 0.1 * rate * (certain[:, None] * shape)
            size = {"none": 0.0, "constant": 0.1, "huge": 1e6}[kind]
            return np.broadcast_to(size * shape, (*x.shape[:-1], n, 2))

        self.diffusion = lambda t, x: sigma(np.asarray(t) / T, x / X[:, 0]) * (X / np.sqrt(T))

    # ------------------------------------------------------------------ what it costs, what else

    def _discs(self, path: Array, side: float) -> None:
        """Discs near the known path in the first two states, to be kept out of (or within)."""
        count, dims, X = 2, min(2, path.shape[1]), self.X
        at = path[self._rng.integers(len(path), size=count), :dims]
        centres = at + 0.3 * self._rng.normal(size=(count, dims))
        radius2 = self._rng.uniform(0.05, 0.4, size=count)

        def c(t, x):
            y = (x / X)[..., None, :dims] - centres
            return side * (radius2 - np.sum(y * y, axis=-1))

        self.penalty = c
        self.penalty_weight = self.C / self.T * 10.0 ** self._rng.uniform(0, 4, size=count)

    def _set_penalty(self, path: Array) -> None:
        self._discs(path, 1.0)

    def _set_walls(self, path: Array) -> None:
        self._discs(path, -1.0)

    def _set_state_cost(self, path: Array) -> None:
        root, X, per = self._rng.normal(size=(path.shape[1],) * 2), self.X, self.C / self.T
        self.state_cost = lambda t, x: per * np.sum(((x / X) @ root) ** 2, axis=-1)

    def _set_wavy_cost(self, path: Array) -> None:
        slope, X, per = self._rng.normal(size=path.shape[1]), self.X, self.C / self.T
        self.state_cost = lambda t, x: per * np.cos((x / X) @ slope)

    def _set_control_cost(self, path: Array) -> None:
        L = self._rng.normal(size=(self.recipe.kind.controls, path.shape[1]))
        X, per = self.X, self.C / self.T / self.U
        self.control_cost = lambda t, x: per * np.sin((x / X) @ L.T)

    def _set_constraint(self, path: Array) -> None:
        slope, X = self._rng.normal(size=path.shape[1]), self.X
        level = float(np.max(path @ slope)) + 0.2
        self.constraint = lambda t, x: ((x / X) @ slope)[..., None] - level

    def _set_terminal_weight(self, path: Array) -> None:
        q = np.shape(self.terminal(self.start))[0]
        self.terminal_weight = self.C * 10.0 ** self._rng.uniform(0, 3, size=q)

    def _set_start_covariance(self, path: Array) -> None:
        root = 0.1 * self._rng.normal(size=(path.shape[1],) * 2)
        self.start_covariance = np.outer(self.X, self.X) * (root @ root.T)

    def _set_angles(self, path: Array) -> None:
        self.angles = (path.shape[1] - 1,)

    def _set_initial_guess(self, path: Array) -> None:
        line = np.linspace(path[0], path[-1], len(path)) + 0.1 * self._rng.normal(size=path.shape)
        u = self._rng.normal(size=(len(path) - 1, self.recipe.kind.controls))
        self.initial_guess = lambda: (self.X * line, self.U * u)

    def _set_given_jacobian(self, path: Array) -> None:
        """Central differences of fourth order, as a user's own code might be."""

        def jacobian(f, x, size):
            columns = []
            for j in range(x.shape[-1]):
                h = np.zeros(x.shape[-1])
                h[j] = 1e-3 * size[j]
                near, wide = f(x + h) - f(x - h), f(x + 2.0 * h) - f(x - 2.0 * h)
                columns.append((8.0 * near - wide) / (12.0 * h[j]))
            return np.stack(columns, axis=-1)

        sizes = self.X, np.full(self.recipe.kind.controls, self.U)
        self.drift_jacobian = lambda t, x, u: (
            jacobian(lambda y: self.drift(t, y, u), x, sizes[0]),
            jacobian(lambda v: self.drift(t, x, v), u, sizes[1]),
        )


def _grid(kind: str, K: int, rng: np.random.Generator) -> Array:
    steps = {
        "even": np.ones(K),
        "uneven": rng.uniform(0.5, 2.0, size=K),
        "wild": 10.0 ** rng.uniform(-3.0, 0.0, size=K),
    }[kind]
    return np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum() * 10.0 ** rng.uniform(-0.5, 0.7)


def _waves(t: Array, m: int, rng: np.random.Generator) -> Array:
    """Smooth controls (K, m) of order one."""
    s = (t[:-1] - t[0]) / (t[-1] - t[0])
    a, b, phase = rng.normal(size=(3, m))
    return a * np.sin(3.0 * s[:, None] + phase) + b * (1.0 - s[:, None])


def _bounds(kind: str, m: int, rng: np.random.Generator) -> tuple[Array, Array, float]:
    size = rng.uniform(0.5, 2.0, size=m)
    free = np.full(m, np.inf)
    lower, upper, radius = -free, free, np.inf
    if kind in ("box", "ball and box"):
        lower, upper = -2.0 * size, 2.0 * size
    elif kind in ("loose", "tight", "tiny"):
        lower, upper = (s * {"loose": 1e3, "tight": 0.5, "tiny": 1e-6}[kind] for s in (-size, size))
    elif kind == "one-sided":
        lower = -0.5 * size
    elif kind == "skew":
        lower, upper = 0.1 * size, 0.3 * size  # zero is no admissible control
    if kind.startswith("ball"):
        radius = float(1.5 * size.max())
    return lower, upper, radius


def recipes(kinds: int, seed: int = 0, *, most_intervals: int = 200) -> st.SearchStrategy[Recipe]:
    """Problems of a number of kinds, which the seed chooses; the simplest first."""
    rng = np.random.default_rng(seed)
    pool = [Kind(), *(Kind.drawn(rng) for _ in range(kinds - 1))]
    power = st.sampled_from((0, 0, 0, -1, 1, -3, 3, -6, 6))
    counts = [K for K in (20, 10, 5, 3, 2, 1, 40, 80, 200) if most_intervals >= K]
    return st.builds(
        Recipe,
        kind=st.sampled_from(pool),
        seed=st.integers(0, 2**32 - 1),
        intervals=st.sampled_from(counts),
        grid=st.sampled_from(("even", "even", "uneven", "wild")),
        bounds=st.sampled_from(BOUNDS),
        exponents=st.one_of(st.just((0, 0, 0, 0)), st.tuples(power, power, power, power)),
        spread=st.sampled_from((False, False, False, True)),
    )
