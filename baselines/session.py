"""What every training session needs: one thread, float32, its own random states, a bar."""

from __future__ import annotations

import contextlib
import random
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from slipcar.baselines.score import Score


class Bar(tqdm):
    """A progress bar in environment steps."""

    def tell(self, found: Score) -> None:
        """Show the last validation beside it."""
        collisions = f"{100.0 * found.collision_rate:.1f} %"
        self.set_postfix_str(f"cost {found.total:.3f}, collisions {collisions}", refresh=False)


def bar_for(name: str, total: int, shown: bool, done: int = 0) -> Any:
    """A bar over `total` environment steps, of which `done` are done."""
    return Bar(
        total=total, initial=done, unit=" steps", unit_scale=True, desc=name,
        # A log file keeps every line that a terminal overwrites.
        mininterval=0.5 if sys.stderr.isatty() else 15.0,
        disable=not shown,
    )  # fmt: skip


@contextlib.contextmanager
def training_session() -> Iterator[None]:
    """One torch thread, since more slow so small a network down; put back afterwards.

    So are the global random states of Python, NumPy and torch, which training seeds, and torch's
    default dtype: networks are float32, as what they are shown, whatever the caller's default is.
    """
    threads, dtype = torch.get_num_threads(), torch.get_default_dtype()
    states = random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.set_default_dtype(dtype)
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        torch.set_rng_state(states[2])
