"""What can be found out before any computing: folders, files, packages and the display."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

#: Endings that figures may have.
FIGURES = (".png", ".pdf", ".svg")


def check_folder(folder: Path) -> None:
    """Whether files can be written into a folder, which is made later if it is not there.

    Raises:
        OSError: naming what is in the way.
    """
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise NotADirectoryError(f"cannot write into {folder}: {there} is no folder")
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise OSError(
            f"cannot write into {folder}: {there} does not let files be made ({error.strerror}); "
            "name another folder"
        ) from error


def check_file(path: Path | None, suffixes: Sequence[str] = (), what: str = "a file") -> None:
    """Whether a file can be written; None is fine.

    Raises:
        ValueError: for another suffix than those, or a folder.
        OSError: naming what is in the way.
    """
    if path is None:
        return
    if suffixes and path.suffix not in suffixes:
        *first, last = suffixes
        named = f"{', '.join(first)} or {last}" if first else last
        raise ValueError(f"{what}'s name ends in {named}, not {path.name!r}")
    if path.is_dir():
        raise ValueError(f"{path} is a folder, not a file to write")
    check_folder(path.parent)


def check_figures(wanted: bool = True, without: str = "") -> None:
    """Whether figures can be drawn, if they are wanted.

    Args:
        wanted: nothing is checked otherwise.
        without: what to say to go without them.

    Raises:
        ImportError: naming what to install.
    """
    if not wanted:
        return
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        from slipcar.envs.extras import install

        raise ImportError(
            f"figures need matplotlib ({error}): {install('plot')}"
            + (f", or go without: {without}" if without else "")
        ) from error


def check_display() -> None:
    """Whether a window can be opened where somebody sees it.

    Raises:
        ImportError: without pygame.
        ValueError: without a display.
    """
    from gymnasium.error import DependencyNotInstalled, Error

    from slipcar.envs.pictures.canvas import open_display

    try:
        pygame = open_display()
    except DependencyNotInstalled as error:  # Gymnasium's own, no ImportError
        raise ImportError(str(error)) from error
    except Error as error:
        raise ValueError(
            "--human needs a display, and there is none; --video and --gif film without"
        ) from error
    pygame.display.quit()
