"""IPOPT's answers, remembered on disk: they do not change, and planners are compared often.

An answer is kept under a hash of all it depends on: the problem's functions and numbers, the
guess, the tolerance, the solver's version and the text of the modules that pose the problem.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import os
from pathlib import Path

import casadi as ca
import numpy as np

from .transcription import Guess, Programme, Solved

_SOURCES = ("symbols.py", "transcription.py")
_PLAIN = ("cost", "iterations", "converged", "status", "seconds")


def solved(programme: Programme, guess: Guess | None, folder: Path) -> Solved:
    """What a programme answers from a guess (None: the problem's own), now or at another time."""
    guess = programme.model.guess() if guess is None else guess
    path = folder / f"{_name(programme, guess)}.npz"
    if path.is_file():
        with np.load(path, allow_pickle=False) as file:
            plain = {name: file[name].item() for name in _PLAIN}
            return Solved(states=file["states"], controls=file["controls"], **plain)
    answer = programme.solve(guess)
    folder.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.npz")
    np.savez_compressed(temporary, **dataclasses.asdict(answer))
    os.replace(temporary, path)
    return answer


def _name(programme: Programme, guess: Guess) -> str:
    digest = hashlib.blake2b(_fixed() + programme.key, digest_size=16)
    for array in guess:
        digest.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
    return digest.hexdigest()


@functools.cache
def _fixed() -> bytes:
    texts = [(Path(__file__).parent / name).read_text(encoding="utf-8") for name in _SOURCES]
    return "\n".join([ca.__version__, *texts]).encode()
