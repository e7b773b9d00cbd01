"""IPOPT on the whole problem of many worlds, remembered on disk: its answers do not change.

An answer is kept under a hash of all it depends on: the world, the guess, the solver's version
and tolerance, and the text of the modules that state the problem to it. Only controls are kept;
what they cost is judged anew each time.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import time
from pathlib import Path

import numpy as np
from contenders import Answer

from slipcar.envs import Scenario

Guess = tuple[np.ndarray, np.ndarray]

#: Modules whose text says what is solved and how.
_SOURCES = ("casadi_nlp.py", "casadi_car.py")


@dataclasses.dataclass(frozen=True)
class Timed:
    """An answer and how long it took (building the programme excluded)."""

    answer: Answer
    seconds: float


class Ipopt:
    """Solves or remembers.

    Args:
        path: file of the answers, .npz; need not exist.
        tolerance: IPOPT's `tol`.
    """

    def __init__(self, path: Path, tolerance: float) -> None:
        import casadi

        self.path, self.tolerance = path, tolerance
        self.solved = 0
        folder = Path(__file__).parent
        sources = [(folder / name).read_text(encoding="utf-8") for name in _SOURCES]
        self._fixed = "\n".join([casadi.__version__, repr(tolerance), *sources])
        self._known: dict[str, Timed] = {}
        if path.is_file():
            with np.load(path, allow_pickle=False) as file:
                columns = [file[name] for name in ("keys", "found", "iterations", "seconds")]
                for i, (key, found, iterations, seconds) in enumerate(zip(*columns, strict=True)):
                    answer = Answer(file[f"controls{i}"], int(iterations), bool(found))
                    self._known[str(key)] = Timed(answer, float(seconds))

    def solve(self, scenario: Scenario, guesses: dict[str, Guess]) -> dict[str, Timed]:
        """An answer from each guess, by its name."""
        keys = {name: self._key(scenario, guess) for name, guess in guesses.items()}
        missing = [name for name, key in keys.items() if key not in self._known]
        if missing:
            from casadi_nlp import WholeNlp

            nlp = WholeNlp(scenario, "ipopt", tolerance=self.tolerance)
            for name in missing:
                began = time.perf_counter()
                found = nlp.solve(guesses[name])
                seconds = time.perf_counter() - began
                self._known[keys[name]] = Timed(nlp.answer(found), seconds)
            self.solved += len(missing)
        return {name: self._known[key] for name, key in keys.items()}

    def save(self) -> None:
        """Write all answers, atomically."""
        if not self.solved:
            return
        known = self._known.values()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.path.with_name(f".{self.path.name}.{os.getpid()}.tmp.npz")
        try:
            np.savez_compressed(
                temporary,
                keys=np.array(list(self._known)),
                found=np.array([timed.answer.found for timed in known]),
                iterations=np.array([timed.answer.iterations for timed in known]),
                seconds=np.array([timed.seconds for timed in known]),
                **{f"controls{i}": timed.answer.controls for i, timed in enumerate(known)},
            )
            os.replace(temporary, self.path)
        finally:
            temporary.unlink(missing_ok=True)

    def _key(self, scenario: Scenario, guess: Guess) -> str:
        digest = hashlib.sha256(f"{self._fixed}\n{scenario.to_json()}".encode())
        for array in guess:
            digest.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
        return digest.hexdigest()
