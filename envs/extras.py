"""How to install what is missing: a command that works from a checkout as well as from an index."""

from __future__ import annotations

import importlib.metadata
import re


def install(extra: str) -> str:
    """`pip install` with the packages of an extra of slipcar, as its metadata has them.

    The packages by name, not `slipcar[extra]`: that would fetch slipcar from an index, which need
    not know it, or replace a checkout.
    """
    try:
        requirements = importlib.metadata.requires("slipcar") or []
    except importlib.metadata.PackageNotFoundError:  # run from a folder, not installed
        requirements = []
    named = [
        requirement.partition(";")[0].strip()
        for requirement in requirements
        if re.search(rf"""extra == ["']{extra}["']""", requirement)
    ]
    if not named:
        return f"pip install '.[{extra}]' in the checkout"
    return f"pip install {' '.join(repr(name) for name in named)}"
