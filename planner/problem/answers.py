"""What a problem's functions answer at a few points, looked at for shape."""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.planner.problem.numbers import finite, fits

Array = np.ndarray
_ARGUMENTS = {"drift": "t, x, u", "terminal": "x"}
#: Shapes of values at one point, by dimension; "?" is any.
_VALUES: dict[str, tuple[str, ...]] = {
    "drift": ("n",), "diffusion": ("n", "?"), "terminal": ("?",), "penalty": ("?",),
    "constraint": ("?",), "state_cost": (), "control_cost": ("m",),
}  # fmt: skip


def answers(
    problem: Any, t: Array, x: Array, u: Array, *, names: tuple[str, ...] = tuple(_VALUES),
    at_start: bool = False,
) -> dict[str, Array]:  # fmt: skip
    """Values of a problem's functions, and of the derivatives that it gives, at P points.

    A function that ignores its batch, or whose shape depends on the point, is noticed.

    Args:
        problem: whose functions.
        t: times, (P,).
        x: states, (P, n).
        u: controls, (P, m).
        names: of the functions.
        at_start: values must be finite too, and messages say where.

    Returns:
        By name, those that the problem has: drift (P, n), ..., drift_jacobian as one array
        (P, n, n + m).

    Raises:
        ValueError: naming the function and the shape or the entry; or an argument written to.
    """
    t, x, u = (_read_only(a) for a in (t, x, u))
    sizes: dict[str, Any] = {"n": x.shape[1], "m": u.shape[1], "?": None}
    given: dict[str, Array] = {}
    for name in names:
        if getattr(problem, name, None) is None:
            continue
        arguments = {"drift": (t, x, u), "terminal": (x,)}.get(name, (t, x))
        label = f"({_ARGUMENTS.get(name, 't, x')})"
        value = _call(problem, name, label, arguments)
        shape = (len(t), *(sizes[size] for size in _VALUES[name]))
        given[name] = _shaped(f"{name}{label}", value, shape, at_start)
        derivative = f"{name}_{'derivatives' if name == 'state_cost' else 'jacobian'}"
        if getattr(problem, derivative, None) is not None:
            parts = _call(problem, derivative, label, arguments)
            by_x = (*given[name].shape, x.shape[1])
            shapes = {
                "drift": (by_x, (*given[name].shape, u.shape[1])),
                "state_cost": (by_x, (*by_x, x.shape[1])),
            }.get(name)
            if shapes is None:
                given[derivative] = _shaped(f"{derivative}{label}", parts, by_x, False)
            else:
                for i, (part, wanted) in enumerate(zip(parts, shapes, strict=True)):
                    _shaped(f"{derivative}{label}[{i}]", part, wanted, False)
    return given


def _call(problem: Any, name: str, label: str, arguments: tuple[Array, ...]) -> Any:
    try:
        return getattr(problem, name)(*arguments)
    except ValueError as error:
        if "read-only" not in str(error):
            raise
        raise ValueError(
            f"{name}{label} wrote into its argument ({error}): copy it first, x = x.copy()"
        ) from error


def _shaped(label: str, value: Any, shape: tuple[int | None, ...], at_start: bool) -> Array:
    if at_start:
        return finite(f"{label} at the start", value, shape)
    array = np.asarray(value, dtype=np.float64)
    if not fits(array, shape):
        wanted = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
        raise ValueError(
            f"{label} must have shape {wanted} for {shape[0]} points, not {array.shape}"
        )
    return array


def _read_only(array: Array) -> Array:
    view = array.view()
    view.flags.writeable = False
    return view
