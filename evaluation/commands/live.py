"""`slipcar live`."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import webbrowser
from typing import Annotated, Any

import tyro

from slipcar.evaluation.commands.inputs import ScenarioOption, read_scenario
from slipcar.evaluation.commands.output import Output, OutputOption


def live(
    *,
    scenario: ScenarioOption = "paper",
    problem: tuple[str, ...] = (),
    host: str = "127.0.0.1",
    port: int = 8123,
    open: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    output: OutputOption = Output(),  # noqa: B008  frozen
) -> int:
    """Serve a page on which obstacles, start and goal are dragged and the plan follows.

    It shows the plan, its covariance, 200 noisy paths with their collisions and what all of it
    costs; open loop, with feedback, at a risk that is verified, or driving while one drags. Needs
    slipcar[live]. Ends with Ctrl-C.

        slipcar live --open
        slipcar live --scenario random:7 --port 0
        slipcar live --problem examples/boat.py:Boat

    Calls slipcar.evaluation.live.server.application.

    Args:
        scenario: which world a new tab shows.
        problem: problems of your own beside the car, as module:object or file.py:object, each with
            an attribute `plane` that names the two states to draw. The page reaches their numbers,
            no other code or file.
        host: address to serve on; other than the loopback, everyone who reaches it may plan.
        port: to serve on; 0 takes one that is free.
        open: show it in the browser.
        output: what is printed.
    """
    if importlib.util.find_spec("aiohttp") is None:
        raise ImportError('the live page needs aiohttp: pip install "slipcar[live]"')
    from slipcar.evaluation.live import server
    from slipcar.evaluation.own.load import load_object

    if not 0 <= port <= 65535:
        raise ValueError(f"port must be between 0 and 65535, not {port}")
    world = read_scenario(scenario)
    systems: dict[str, Any] = {}
    for text in problem:
        found = load_object(text)
        systems[text.rpartition(":")[2]] = found() if isinstance(found, type) else found
    local = host in server.LOOPBACK
    app = server.application(world, systems, loopback=local)
    said = output.console()

    def ready(address: str) -> None:
        output.data({"address": address})
        said.print(f"{address}  (Ctrl-C ends it)", markup=False, soft_wrap=True)
        if not local:
            said.print(f"everyone who reaches {host} may plan on this machine", style="bold red")
        if open:
            webbrowser.open(address)

    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(server.serve(app, host, port, ready))
    return 0
