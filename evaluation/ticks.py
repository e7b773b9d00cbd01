"""How far a cell is that another process works on: it writes that down, whoever waits reads it."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path

#: Seconds between two writes of a cell.
_PAUSE = 0.5


@dataclasses.dataclass(frozen=True)
class Ticks:
    """A folder, on this machine, with a small file for each cell under way."""

    folder: str

    def writer(self, cell: str) -> Callable[[float], None]:
        """What a worker calls with the episodes it has done; it writes twice a second at most.

        What cannot be written is not worth an error.
        """
        last = time.monotonic()

        def write(episodes: float) -> None:
            nonlocal last
            now = time.monotonic()
            if now - last >= _PAUSE:
                last = now
                with contextlib.suppress(OSError):
                    Path(self.folder, cell).write_text(repr(episodes), encoding="ascii")

        return write

    def read(self) -> Iterator[tuple[str, float]]:
        """Cells and the episodes they have done; files that are being written are left out."""
        for path in Path(self.folder).iterdir():
            try:
                yield path.name, float(path.read_text(encoding="ascii"))
            except (OSError, ValueError):
                continue
