"""Print a version's part of CHANGELOG.md: python .github/release_notes.py 0.1.0."""

import re
import sys
from pathlib import Path

CHANGELOG = Path(__file__).resolve().parents[1] / "CHANGELOG.md"


def notes(version: str, changelog: str) -> str:
    """What stands under `## [version]`.

    Raises:
        ValueError: if the changelog does not know the version.
    """
    parts = re.split(r"^## \[([^]]+)\].*$", changelog, flags=re.MULTILINE)[1:]
    known = dict(zip(parts[::2], parts[1::2], strict=True))
    if version not in known:
        raise ValueError(f"CHANGELOG.md has no version {version!r}; it has {', '.join(known)}")
    return known[version].strip()


if __name__ == "__main__":
    print(notes(sys.argv[1], CHANGELOG.read_text(encoding="utf-8")))
