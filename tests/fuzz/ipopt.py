"""Whether IPOPT, from where the planner starts, meets the terminal condition that it did not."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

_FOLDER = str(Path(__file__).resolve().parents[2] / "benchmarks")

#: Why there is no second opinion here; empty where there is one.
MISSING = (
    ""
    if importlib.util.find_spec("casadi")
    else 'casadi is not installed: pip install "slipcar[bench]"'
)


def meets(problem: Any) -> bool | None:
    """True if IPOPT converges; None where it cannot be asked (a ball, what cannot be traced)."""
    if MISSING or getattr(problem, "control_radius", None) is not None:
        return None
    sys.path.insert(0, _FOLDER)
    try:
        transcription = importlib.import_module("systems.transcription")
        return bool(transcription.Programme(problem, tolerance=1e-7).solve().converged)
    except (ValueError, TypeError, AttributeError, RuntimeError):
        return None
    finally:
        sys.path.remove(_FOLDER)
