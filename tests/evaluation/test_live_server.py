"""The live page's server without a browser: who is answered, and what is said of bad requests."""

import asyncio
import contextlib
import json
import socket

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation.cli import main
from slipcar.evaluation.live.cloud import cloud, violated
from slipcar.evaluation.live.request import plane_of
from slipcar.planner import Feedback, plan

aiohttp = pytest.importorskip("aiohttp", reason='not installed: pip install "slipcar[live]"')
PAPER = Scenario.named("paper")


def server():
    from slipcar.evaluation.live import server

    return server


def asked(tab=None, **request):
    """Header and arrays of the answer to a request."""
    text = json.dumps({"id": 7, "world": PAPER.to_dict(), **request})
    answer = (tab or server().Tab({})).answer(text)
    size = int.from_bytes(answer[:4], "little")
    header = json.loads(answer[4 : 4 + size])
    assert header["id"] == 7
    rest, arrays = np.frombuffer(answer[4 + size :], "<f4"), {}
    for name, shape in header["arrays"]:
        arrays[name], rest = rest[: np.prod(shape)].reshape(shape), rest[np.prod(shape) :]
    assert len(rest) == 0
    return header, arrays


def test_a_picture_is_the_plan_and_its_paths():
    header, arrays = asked()
    p = plan(PAPER, feedback=True)
    np.testing.assert_allclose(arrays["mean"], p.mean[:, :2], atol=1e-5)
    assert arrays["cloud"].shape == (200, 41, 2)
    assert header["hits"] == arrays["broken"].sum()
    assert header["predicted"] == pytest.approx(p.expected.risk)
    assert sum(header["cost"].values()) == pytest.approx(p.expected.total)


def test_a_quick_plan_says_so_and_how():
    header, _ = asked(quick=True)
    assert header["quick"]
    assert "starts=1" in header["python"]
    assert not asked()[0]["quick"]


def test_paths_have_the_spread_of_the_covariance():
    p = plan(PAPER, feedback=True)
    states = cloud(PAPER, Feedback(p).control, 20_000)
    for k in (10, 25, 40):
        got = np.cov(states[:, k, :2].T)
        np.testing.assert_allclose(got, p.covariance[k, :2, :2], atol=0.15 * got.max())
    assert violated(PAPER, states).mean() < p.expected.risk * 1.5


def test_paths_that_leave_the_numbers_count_as_collisions():
    states = np.full((3, 41, 5), np.nan)
    assert violated(PAPER, states).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"world": {**PAPER.to_dict(), "horizon": 0.0}}, "horizon must be finite and > 0"),
        ({"world": {**PAPER.to_dict(), "horizon": 1e9}}, "horizon must be from 0.1 to 100"),
        ({"world": {**PAPER.to_dict(), "nodes": 10**9}}, "nodes must be at most 201"),
        ({"world": {**PAPER.to_dict(), "obstacles": [[5, 5, 0.1]] * 99}}, "obstacles: at most"),
        ({"world": {**PAPER.to_dict(), "obstacles": [[0, 0, 0.3]]}}, r"obstacles[0] (centre"),
        ({"world": {**PAPER.to_dict(), "goal": [1e200] * 5}}, "goal: numbers must be within"),
        ({"world": {**PAPER.to_dict(), "slip": [0.1, None]}}, "slip"),
        ({"world": "paper"}, "world must be an object"),
        ({"mode": "__import__"}, "mode must be one of"),
        ({"policy": "/etc/passwd"}, "policy must be one of"),
        ({"system": "os:system"}, "system must be one of ['car'], not 'os:system'"),
        ({"price": -1.0}, "price must be between"),
        ({"price": "1"}, "price must be between"),
        ({"risk": 1.5}, "risk must be between"),
        ({"quick": None}, "quick must be true or false"),
        ({"verify": 1}, "verify must be true or false"),
        ({"file": "x"}, "nothing like ['file']"),
    ],
)
def test_a_bad_request_is_told_what_is_wrong(change, words):
    assert words in asked(**change)[0]["error"]


@pytest.mark.parametrize("text", ["", "[]", "{", "null", '{"id": "x"}', "[" * 10_000, "1e999"])
def test_what_is_no_request_gets_an_answer_too(text):
    answer = server().Tab({}).answer(text)
    size = int.from_bytes(answer[:4], "little")
    assert json.loads(answer[4 : 4 + size])["error"]


def test_a_plan_that_does_not_converge_is_shown_and_said_so():
    header, arrays = asked(mode="open", world={**PAPER.to_dict(), "horizon": 0.5})
    assert not header["ok"]
    assert header["message"]
    assert len(arrays["mean"]) == 41


def test_a_drive_replans_for_the_world_as_it_is_and_arrives():
    tab = server().Tab({})
    world = PAPER.to_dict()
    header, arrays = asked(tab, mode="drive", begin=True, seed=3)
    assert header["drive"]["step"] == 1
    free = arrays["mean"]
    world["obstacles"][0][:2] = [0.9, 1.7]  # into its way
    header, arrays = asked(tab, mode="drive", world=world)
    assert header["drive"]["step"] == 2
    assert np.abs(arrays["mean"] - free[1:]).max() > 0.05
    while not header["drive"]["done"]:
        header, arrays = asked(tab, mode="drive", world=world)
    assert header["drive"]["step"] == 40
    assert header["drive"]["off"] < 0.5
    assert arrays["trail"].shape == (41, 2)


def test_another_tab_has_another_drive():
    one, two = server().Tab({}), server().Tab({})
    for _ in range(3):
        asked(one, mode="drive")
    assert asked(two, mode="drive")[0]["drive"]["step"] == 1


@contextlib.asynccontextmanager
async def serving(**options):
    from aiohttp.test_utils import TestClient, TestServer

    app = server().application(PAPER, {}, **{"loopback": True, **options})
    async with TestClient(TestServer(app)) as client:
        yield client


def status(path, headers, **options):
    async def get():
        async with serving(**options) as client, client.get(path, headers=headers) as answer:
            return answer.status

    return asyncio.run(get())


def test_nothing_but_the_page_is_served():
    for path in ("/", "/live.js", "/draw.js", "/live.css"):
        assert status(path, {}) == 200
    for path in ("/live.html", "/../server.py", "/%2e%2e/server.py", "/etc/passwd", "/__init__.py"):
        assert status(path, {}) == 404


def test_another_site_cannot_open_the_socket_nor_take_its_name():
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket"}
    assert status("/socket", upgrade) == 403
    assert status("/socket", {**upgrade, "Origin": "http://evil.example"}) == 403
    assert status("/", {"Host": "evil.example"}) == 403
    assert status("/", {"Host": "evil.example"}, loopback=False) == 200


def test_the_page_itself_is_answered():
    async def talk():
        async with serving() as client:
            origin = f"http://{client.host}:{client.port}"
            async with client.ws_connect("/socket", origin=origin) as tab:
                hello = json.loads((await tab.receive()).data)
                await tab.send_str(json.dumps({"id": 1, "world": hello["first"]}))
                return (await tab.receive()).data

    assert len(asyncio.run(talk())) > 10_000


def test_a_port_in_use_is_one_line(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["live", "--port", str(port)]) == 2
    error = capsys.readouterr().err
    assert f"port {port}" in error
    assert "--port 0" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--port", "99999"], "port must be between 0 and 65535"),
        (["--problem", "nowhere.py:Boat"], "there is no file"),
        (["--problem", "boat"], "neither module:object nor"),
        (["--problem", "fractions:Fraction"], "Fraction"),
        (["--scenario", "nowhere"], "unknown scenario"),
        (["--host", "192.0.2.1", "--port", "0"], "cannot serve on 192.0.2.1"),
    ],
)
def test_bad_arguments_are_one_line(arguments, words, capsys):
    assert main(["live", *arguments]) == 2
    assert words in capsys.readouterr().err


def test_a_problem_names_its_plane():
    class Flat:
        start, times, control_weight = np.zeros(3), np.linspace(0.0, 1.0, 5), np.eye(1)
        plane = (0, 3)

        def drift(self, t, x, u):
            return np.concatenate([x[..., 1:], u], axis=-1)

        def diffusion(self, t, x):
            return np.zeros((*x.shape, 1))

        def terminal(self, x):
            return x - 1.0

    with pytest.raises(ValueError, match=r"Flat\.plane must be two different"):
        plane_of(Flat())
    Flat.plane = (0, 2)
    assert plane_of(Flat()) == (0, 2)
    assert plane_of(PAPER) == (0, 1)
