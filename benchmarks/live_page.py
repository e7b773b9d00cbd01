"""The live page in Chromium on this machine: updates a second while dragging, input to picture.

python benchmarks/live_page.py picture docs/live.png      the picture in the docs
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from report import Section

ABOUT = """\
`slipcar live` and headless Chromium on the same machine; an obstacle is dragged in a circle for
some seconds, with feedback and 200 noisy paths. Inputs come as fast as the page takes them, at most
at 60 a second as from a mouse. A time goes from the event's stamp in the browser to where the
picture that answers it is on the canvas; an update is such a picture. After a whole plan that took
more than 60 ms the page drags by quick ones, of one guess instead of six: their share is told.
"""
SECONDS = 10.0
MODES = (
    ("plan with feedback", "paper", ""),
    ("open loop", "paper", ""),
    ("plan with feedback", "slalom", ""),
    ("plan with feedback", "paper", "PPO, trained on the paper's world"),
)
_SIZE = {"width": 1200, "height": 800}
_NAMES = ("chromium", "chromium-browser", "google-chrome")


def section() -> Section:
    """A row for each mode."""
    try:
        rows = [row(*mode) for mode in MODES]
    except (ImportError, FileNotFoundError) as missing:
        return Section("live_page", "Live page", ABOUT, {}, notes=(str(missing),))
    return Section("live_page", "Live page", ABOUT, {"While an obstacle is dragged": rows})


def row(mode: str, world: str, policy: str, seconds: float = SECONDS) -> dict[str, Any]:
    """Drag for some seconds and read what the page measured."""
    with opened(world) as page:
        page.click(f"text={mode}")
        if policy:
            page.select_option("#policy", policy)
        page.wait_for_timeout(2000)
        page.evaluate(
            "slipcarLive.latencies.length = slipcarLive.drawn.length = 0;"
            "slipcarLive.answers = slipcarLive.quick = 0"
        )
        dragged(page, seconds)
        measured = page.evaluate(
            "({ms: slipcarLive.latencies, drawn: slipcarLive.drawn,"
            " quick: slipcarLive.quick / slipcarLive.answers})"
        )
    ms, drawn = np.array(measured["ms"]), np.array(measured["drawn"])
    return {
        "mode": mode,
        "world": world,
        "beside it": policy or "–",
        "updates a second": 1e3 * (len(drawn) - 1) / (drawn[-1] - drawn[0]),
        "input to picture [ms], median": float(np.median(ms)),
        "95 %": float(np.quantile(ms, 0.95)),
        "inputs": len(ms),
        "quick plans [%]": 100.0 * measured["quick"],
    }


def dragged(page: Any, seconds: float) -> None:
    """Drag the first obstacle in a circle of 50 pixels, from within the browser.

    The pointer events come from a timer of the page's own, as a driver would be slower than a hand.
    """
    page.evaluate(
        """(seconds) => new Promise((done) => {
          const handle = document.querySelector('[data-key="obstacles[0]"]');
          const box = handle.getBoundingClientRect();
          const x = box.x + box.width / 2, y = box.y + box.height / 2, id = 1;
          const send = (kind, px, py) => handle.dispatchEvent(new PointerEvent(kind,
            { pointerId: id, clientX: px, clientY: py, bubbles: true }));
          handle.setPointerCapture = () => {};
          send("pointerdown", x, y);
          const began = performance.now();
          const timer = setInterval(() => {
            const a = (performance.now() - began) / 700;
            send("pointermove", x + 50 * Math.sin(a), y + 50 * (1 - Math.cos(a)));
            if (performance.now() - began > 1e3 * seconds) {
              clearInterval(timer); send("pointerup", x, y); setTimeout(done, 300);
            }
          }, 1000 / 60);
        })""",
        seconds,
    )


@contextlib.contextmanager
def opened(world: str, **options: Any) -> Iterator[Any]:
    """The page of a server of its own, in Chromium.

    Raises:
        ImportError: if playwright or aiohttp is missing.
        FileNotFoundError: if there is no Chromium.
    """
    import aiohttp  # noqa: F401
    from playwright.sync_api import sync_playwright

    chromium = next(filter(None, map(shutil.which, _NAMES)), None)
    if chromium is None:
        raise FileNotFoundError(f"no browser: none of {', '.join(_NAMES)}")
    command = [sys.executable, "-m", "slipcar.evaluation", "live", "--port", "0"]
    server = subprocess.Popen(
        [*command, "--scenario", world], stdout=subprocess.PIPE, text=True, bufsize=1
    )
    try:
        assert server.stdout is not None
        address = server.stdout.readline().split()[0]
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            page = browser.new_page(viewport=_SIZE, **options)
            page.goto(address)
            page.wait_for_selector("#numbers dd")
            yield page
            browser.close()
    finally:
        server.terminate()
        server.wait(20)


def picture(path: Path) -> None:
    """What the page looks like in the middle of a drag."""
    with opened("paper") as page:
        page.click("text=open loop")
        dragged(page, 2.0)
        page.wait_for_timeout(500)
        page.evaluate("document.activeElement.blur()")
        page.screenshot(path=path)


if __name__ == "__main__":
    if sys.argv[1:2] != ["picture"] or len(sys.argv) != 3:
        sys.exit(__doc__)
    picture(Path(sys.argv[2]))
