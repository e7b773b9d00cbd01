"""The server of the live page: three fixed files, and a socket for each tab.

What arrives on a socket is a request (:mod:`.request`) or a tick of a drive; what goes back is a
picture, or what is wrong with the request. A tab asks for one picture at a time, so a slow machine
draws fewer of them and none is out of date; when nothing is dragged, nothing runs.

Any page of the web may open a socket to this machine: only those that the page itself opened are
answered (`Origin`), and, on the loopback, only under names of the loopback (`Host`).
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.resources
import json
import logging
import signal
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from urllib.parse import urlsplit

from aiohttp import WSMsgType, web

from slipcar.envs import Scenario
from slipcar.evaluation.live.drive import Drive
from slipcar.evaluation.live.picture import Picture, picture
from slipcar.evaluation.live.policies import policy_names
from slipcar.evaluation.live.request import CAR, MODES, Request, draggable, plane_of

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_FILES = {
    "/": ("live.html", "text/html"),
    "/live.css": ("live.css", "text/css"),
    "/live.js": ("live.js", "text/javascript"),
    "/draw.js": ("draw.js", "text/javascript"),
}
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
_log = logging.getLogger(__name__)
#: Bytes of a request, at most.
_LONGEST = 64 * 1024


def application(first: Scenario, systems: Mapping[str, Any], *, loopback: bool) -> web.Application:
    """The page and its socket.

    Args:
        first: the scenario that a new tab shows.
        systems: problems by name, beside the car; each says which `plane` is drawn.
        loopback: answer to names of this machine alone.

    Raises:
        ValueError: for a problem that names no plane.
    """
    for problem in systems.values():
        plane_of(problem)

    @web.middleware
    async def guard(request: web.Request, handler: Any) -> web.StreamResponse:
        _check_origin(request, loopback)
        return await handler(request)

    app = web.Application(middlewares=[guard])
    for path, (name, kind) in _FILES.items():
        app.router.add_get(path, _file(name, kind))
    workers = ThreadPoolExecutor(2, thread_name_prefix="live")
    hello = json.dumps(_hello(first, systems))

    tabs: set[web.WebSocketResponse] = set()

    async def tab(request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse(compress=False, max_msg_size=_LONGEST, heartbeat=30.0)
        await socket.prepare(request)
        tabs.add(socket)
        try:
            await socket.send_str(hello)
            await _answer(socket, Tab(systems), workers)
        finally:
            tabs.discard(socket)
        return socket

    app.router.add_get("/socket", tab)

    async def hang_up(_: web.Application) -> None:
        for socket in list(tabs):
            await socket.close()

    async def close(_: web.Application) -> None:
        workers.shutdown(wait=False, cancel_futures=True)

    app.on_shutdown.append(hang_up)
    app.on_cleanup.append(close)
    return app


def _check_origin(request: web.Request, loopback: bool) -> None:
    host = urlsplit(f"//{request.host}").hostname
    if loopback and host not in LOOPBACK:
        raise web.HTTPForbidden(text=f"this page answers to {' or '.join(LOOPBACK)} alone\n")
    origin = request.headers.get("Origin")
    if request.path == "/socket" and (origin is None or urlsplit(origin).netloc != request.host):
        raise web.HTTPForbidden(text="only the page itself may open this socket\n")


def _file(name: str, kind: str) -> Any:
    text = (importlib.resources.files("slipcar.evaluation.live.page") / name).read_text("utf-8")

    async def answer(_: web.Request) -> web.Response:
        return web.Response(text=text, content_type=kind, charset="utf-8", headers=_HEADERS)

    return answer


def _hello(first: Scenario, systems: Mapping[str, Any]) -> dict[str, Any]:
    """What a page needs to know before it asks."""
    own = {
        name: {
            "plane": list(plane_of(problem)),
            "draggable": list(draggable(problem)),
            "world": {
                member: [list(map(float, row)) for row in value]
                if member == "obstacles"
                else list(map(float, value))
                for member in ("start", "goal", "obstacles")
                if (value := getattr(problem, member, None)) is not None
            },
        }
        for name, problem in systems.items()
    }
    return {
        "scenarios": {name: Scenario.named(name).to_dict() for name in Scenario.names()},
        "first": first.to_dict(),
        "systems": own,
        "car": CAR,
        "modes": MODES,
        "policies": list(policy_names()),
    }


async def _answer(socket: web.WebSocketResponse, tab: Tab, workers: ThreadPoolExecutor) -> None:
    """Answer what arrives until the tab goes away."""
    tasks: set[asyncio.Task[None]] = set()
    async for message in socket:
        if message.type is not WSMsgType.TEXT:
            break
        task = asyncio.create_task(_reply(socket, tab, message.data, workers))
        tasks.add(task)  # a task that nobody holds may be forgotten
        task.add_done_callback(tasks.discard)
        if len(tasks) > 4:  # the page has two under way at most: a picture and a verification
            break
    for task in tasks:
        task.cancel()


async def _reply(
    socket: web.WebSocketResponse, tab: Tab, text: str, workers: ThreadPoolExecutor
) -> None:
    answer = await asyncio.get_running_loop().run_in_executor(workers, tab.answer, text)
    if not socket.closed:
        with contextlib.suppress(ConnectionError):  # the tab may be closed meanwhile
            await socket.send_bytes(answer)


class Tab:
    """One tab: what it asks for is answered from its request alone, but for a drive under way."""

    def __init__(self, systems: Mapping[str, Any]) -> None:
        self._systems = systems
        self._drive: Drive | None = None

    def answer(self, text: str) -> bytes:
        """The answer to a message, whatever it is."""
        number = 0
        try:
            number, asked = Request.from_json(text)
            if isinstance(asked, Request):
                return self._pictured(asked).to_bytes(number)
            error: Exception = asked
        except (ValueError, TypeError, ArithmeticError, RecursionError) as refused:
            error = refused
        except Exception:  # the page goes on, and whoever runs the server is told
            _log.exception("a request failed")
            error = RuntimeError("the server failed: its terminal says how")
        facts = {"error": " ".join(str(error).split()) or type(error).__name__}
        return Picture(facts, {}).to_bytes(number)

    def _pictured(self, asked: Request) -> Picture:
        problem = asked.problem(self._systems)
        if asked.mode != "drive":
            if not asked.verify:
                self._drive = None
            return picture(asked, problem)
        if not isinstance(problem, Scenario):
            raise ValueError(f"mode: only the car drives here, not {asked.system!r}")
        if asked.begin or self._drive is None or self._drive.done:
            self._drive = Drive(problem, asked.seed)
        return self._drive.tick(asked, problem)


async def serve(app: web.Application, host: str, port: int, ready: Any) -> None:
    """Serve until interrupted; `ready` is called with the page's address once it can be opened.

    Raises:
        OSError: if the port is taken or the address is not this machine's, saying so.
    """
    runner, interrupted = web.AppRunner(app, access_log=None), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(NotImplementedError):  # on Windows Ctrl-C raises
            asyncio.get_running_loop().add_signal_handler(number, interrupted.set)
    await runner.setup()
    try:
        try:
            await web.TCPSite(runner, host, port).start()
        except OSError as error:
            raise OSError(
                f"cannot serve on {host}, port {port} ({error.strerror or error}): "
                f"--port 0 takes one that is free"
            ) from error
        bound = runner.addresses[0][1]
        ready(f"http://{f'[{host}]' if ':' in host else host}:{bound}/")
        await interrupted.wait()
    finally:
        await runner.cleanup()
