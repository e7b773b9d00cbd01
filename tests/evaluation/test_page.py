"""The page in a real browser where there is one, and what can be said of its text alone."""

import base64
import hashlib
import itertools
import json
import os
import re
import select
import shutil
import subprocess
import time
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest

from slipcar.evaluation.report.document import Document, Figure
from slipcar.evaluation.report.page import Section, html
from slipcar.evaluation.report.table import Table

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
# Nothing is fetched behind the page's back, and nothing is asked of the system.
OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--disable-extensions",
    "--disable-dev-shm-usage", "--remote-debugging-pipe",
)  # fmt: skip
EVIL = "<script>document.title='owned'</script>\"'&<img src=x onerror=alert(1)>"
SVG = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 300 200" width="300" height="200">'
    "<script>parent.document.title='owned'</script>"
    "<rect width='300' height='200' fill='#0b0'/></svg>"
)
VALUES = (3.0, -1.5, None, 12.0, 0.5, None, 12.0)


def scene():
    times = np.linspace(0.0, 2.0, 9)
    path = np.column_stack([times, 0.3 * times**2, 0.6 * times])
    rows = [
        {
            "name": name,
            "closed": i > 0,
            "shown": True,
            "paths": [(path + np.array([0.0, 0.1 * i + 0.02 * j, 0.0])).tolist() for j in range(3)],
            "hits": [None, 4, None] if i == 0 else [None] * 3,
        }
        for i, name in enumerate(("open", EVIL))
    ]
    steps = [{"path": (path[:, :2] * [1, k / 2]).tolist()} for k in range(3)]
    for step in steps[1:]:
        step.update(effort=1.0, penalty=0.25)
    return {
        "obstacles": [[1.0, 0.6, 0.2]], "clearance": 0.1, "start": [0, 0, 0], "goal": [2, 1.2, 0],
        "times": times.tolist(), "seed": 3, "substeps": 1, "rows": rows,
        "iterates": {"name": EVIL, "guess": True, "steps": steps},
    }  # fmt: skip


def document(title, **change):
    names = [EVIL, *"bcdefg"]
    cells = [
        (n, "–" if v is None else f"{v:.1f} ± 0.1") for n, v in zip(names, VALUES, strict=True)
    ]
    table = Table(
        caption=f"Cost & {EVIL}",
        headers=("controller", "cost"),
        cells=tuple(cells),
        values=tuple((None, value) for value in VALUES),
        bold=frozenset({(1, 1)}),
    )
    wide = Table(
        caption="Wide",
        headers=tuple(f"a long header {i}" for i in range(14)),
        cells=(tuple(f"{i}.123456 ± 0.001" for i in range(14)),),
        values=((None, *map(float, range(13))),),
    )
    frame = pd.DataFrame({"cost": VALUES}, index=pd.Index(names, name="controller"))
    whole = {
        "kind": "compare",
        "title": title,
        "setting": f"Set to {EVIL}",
        "tables": (table, wide),
        "notes": (f"{EVIL} did not finish",),
        "figures": (Figure("shape", f"A shape {EVIL}"), Figure("gone", "Gone")),
        "frames": {"table": frame},
        "provenance": {"cpu": "Z80", "versions": {"numpy": "2.0", EVIL: "1"}, "odd": [1, EVIL]},
        "scene": scene(),
    }
    return Document(**{**whole, **change})


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    (folder / "shape.svg").write_text(SVG, encoding="utf-8")
    sections = [
        Section(document("First"), folder, "compare"),
        Section(document(f"Second {EVIL}", kind="frontier"), folder, "a/frontier"),
        Section(Document("x", "Bare", "", (), (), (), {}, {}), folder, "bare"),
    ]
    path = folder / "report.html"
    path.write_text(html(sections, [f"{EVIL} is damaged"]), encoding="utf-8")
    return path


# ------------------------------------------------------------------ its text


class Elements(HTMLParser):
    """Start tags with their attributes."""

    def __init__(self, text):
        super().__init__()
        self.found, self.texts = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))

    def handle_data(self, data):
        self.texts.append(data)


def test_text_is_escaped_wherever_it_comes_from(page):
    elements = Elements(page.read_text(encoding="utf-8"))
    scripts = [attributes for tag, attributes in elements.found if tag == "script"]
    assert [s.get("type") for s in scripts] == ["application/json", "application/json", None]
    assert not any("onerror" in attributes for _, attributes in elements.found)
    # Where it belongs it is there: problem, titles, settings, notes, tables, provenance.
    assert sum(EVIL in text for text in elements.texts) > 12
    images = [attributes for tag, attributes in elements.found if tag == "img"]
    assert [image["src"].partition(",")[0] for image in images] == ["data:image/svg+xml;base64"] * 2
    assert all(image["alt"] == f"A shape {EVIL}" for image in images)


def test_nothing_is_taken_from_elsewhere(page):
    elements = Elements(page.read_text(encoding="utf-8"))
    for _, attributes in elements.found:
        for key in ("src", "href", "action", "srcset", "data"):
            target = attributes.get(key, "data:")
            assert target is None or target.startswith(("data:", "#"))
    ids = [attributes["id"] for _, attributes in elements.found if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = [a["href"][1:] for _, a in elements.found if str(a.get("href")).startswith("#")]
    assert set(links) <= set(ids)
    assert {"compare-1", "a-frontier-2", "provenance"} <= set(links)


def test_the_policy_allows_the_pages_own_script_alone(page):
    text = page.read_text(encoding="utf-8")
    script = re.search(r"<script>(.*?)</script>\n</body>", text, re.DOTALL).group(1)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = dict(Elements(text).found[3][1])["content"]
    assert policy.startswith("default-src 'none'")
    assert policy.endswith(f"script-src 'sha256-{digest}'")


def test_missing_figures_and_unreadable_results_are_named(page):
    text = page.read_text(encoding="utf-8")
    assert text.count("gone.svg is missing") == 2
    assert "is damaged" in text


def test_provenance_names_every_fact(page):
    texts = [text.strip() for text in Elements(page.read_text(encoding="utf-8")).texts]
    assert texts.count("Z80") == 2
    assert texts.count(f"numpy\u00a02.0, {EVIL}\u00a01") == 2
    assert texts.count(f"1, {EVIL}") == 2


def test_large_frames_stay_beside_the_page(tmp_path):
    frame = pd.DataFrame({"x": np.arange(400_000)})
    text = html([Section(document("Large", frames={"table": frame}), tmp_path, "large")])
    assert "large-table.csv (beside this page)" in text
    assert len(text) < 1_000_000


# ------------------------------------------------------------------ a browser


class Browser:
    """Headless Chromium, driven by the DevTools protocol through a pair of pipes."""

    def __init__(self, profile):
        commands, self.commands = os.pipe()
        self.answers, answers = os.pipe()
        # Chromium reads commands from 3 and answers on 4.
        start = f'exec "$@" 3</dev/fd/{commands} 4>/dev/fd/{answers}'
        self.process = subprocess.Popen(
            ["sh", "-c", start, "sh", CHROMIUM, *OPTIONS, f"--user-data-dir={profile}"],
            pass_fds=(commands, answers),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(commands)
        os.close(answers)
        self.numbers, self.buffer, self.events, self.session = itertools.count(1), b"", [], None
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        attached = self.send("Target.attachToTarget", targetId=target, flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.send(f"{domain}.enable")

    def send(self, method, **params):
        message = {"id": next(self.numbers), "method": method, "params": params}
        if self.session is not None:
            message["sessionId"] = self.session
        os.write(self.commands, json.dumps(message).encode() + b"\0")
        answer = self.wait(lambda found: found.get("id") == message["id"])
        assert "error" not in answer, (method, answer["error"])
        return answer["result"]

    def wait(self, wanted):
        """The first message that is wanted; events on the way are kept."""
        give_up = time.monotonic() + 60.0
        while True:
            while b"\0" not in self.buffer:
                left = give_up - time.monotonic()
                assert left > 0.0, "the browser does not answer"
                if select.select([self.answers], [], [], left)[0]:
                    part = os.read(self.answers, 1 << 20)
                    assert part, "the browser has ended"
                    self.buffer += part
            line, _, self.buffer = self.buffer.partition(b"\0")
            message = json.loads(line)
            if "method" in message:
                self.events.append(message)
            if wanted(message):
                return message

    def open(self, path):
        self.events.clear()
        self.send("Page.navigate", url=path.as_uri())
        self.wait(lambda message: message.get("method") == "Page.loadEventFired")

    def run(self, script):
        found = self.send(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, script):
        """Wait until a script says something true; what it says."""
        give_up = time.monotonic() + 20.0
        while not (found := self.run(script)):
            assert time.monotonic() < give_up, f"never: {script}"
            time.sleep(0.02)
        return found

    def size(self, width, height):
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip

    def key(self, name, code):
        for kind in ("keyDown", "keyUp"):
            text = {"text": "\r"} if name == "Enter" and kind == "keyDown" else {}
            self.send(
                "Input.dispatchKeyEvent", type=kind, key=name, windowsVirtualKeyCode=code, **text
            )

    def mouse(self, kind, x, y, **rest):
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **rest)

    def click(self, selector):
        """Press and release the mouse in the middle of an element."""
        x, y = self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            "e.scrollIntoView({block: 'center', behavior: 'instant'});"
            "const r = e.getBoundingClientRect();"
            "return [r.x + r.width / 2, r.y + r.height / 2]})()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1)

    def close(self):
        os.close(self.commands)
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self.answers)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is found")
    found = Browser(tmp_path_factory.mktemp("profile"))
    yield found
    found.close()


PAINTED = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"


@pytest.fixture
def opened(browser, page):
    browser.size(1280, 900)
    browser.open(page)
    # Chromium drops the input of users to a page that has not been painted.
    browser.run(PAINTED)
    return browser


def kinds(browser, *methods):
    return [event["params"] for event in browser.events if event["method"] in methods]


def test_it_opens_without_network_and_without_complaint(opened):
    urls = [request["request"]["url"] for request in kinds(opened, "Network.requestWillBeSent")]
    assert urls[0].startswith("file://")
    assert all(url.startswith("data:") for url in urls[1:])
    wrong = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
    assert kinds(opened, *wrong) == []
    assert opened.run("document.title") == "slipcar report"  # no name has run as a script
    images = "[...document.images].map(image => image.naturalWidth)"
    assert opened.run(images) == [300, 300]


def test_scripts_in_data_do_not_run_and_the_net_is_closed(opened):
    refused = opened.run(
        "fetch('http://127.0.0.1:9/').then(() => 'open', error => error.constructor.name)"
    )
    assert refused == "TypeError"
    assert any(
        "Content Security Policy" in e["entry"]["text"] for e in kinds(opened, "Log.entryAdded")
    )
    opened.run("document.body.append(Object.assign(document.createElement('script'),"
               "{textContent: 'document.title = 1'}))")  # fmt: skip
    assert opened.run("document.title") == "slipcar report"


COLUMN = "[...document.querySelector('tbody').rows].map(r => r.cells[{}].textContent)"
ORDER = [f"{v:.1f} ± 0.1" for v in (-1.5, 0.5, 3.0, 12.0, 12.0)]


def test_tables_sort_by_number_up_and_down_and_back(opened):
    header = "thead th:nth-child(2)"
    state = f"document.querySelector({json.dumps(header)}).ariaSort"
    written = opened.run(COLUMN.format(1))
    opened.click(f"{header} button")
    assert opened.run(state) == "ascending"
    assert opened.run(COLUMN.format(1)) == [*ORDER, "–", "–"]
    assert opened.run(COLUMN.format(0))[3:] == ["d", "g", "c", "f"]  # stable
    opened.click(f"{header} button")
    assert opened.run(state) == "descending"
    assert opened.run(COLUMN.format(1)) == [*ORDER[::-1], "–", "–"]  # without number: still last
    assert opened.run(COLUMN.format(0))[:2] == ["d", "g"]
    opened.click(f"{header} button")
    assert opened.run(state) == "none"
    assert opened.run(COLUMN.format(1)) == written


def test_tables_sort_by_text_with_the_keyboard(opened):
    opened.run("document.querySelector('thead button').focus()")
    opened.key("Enter", 13)
    assert opened.run(COLUMN.format(0))[1:] == list("bcdefg")
    opened.key("Enter", 13)
    assert opened.run(COLUMN.format(0))[:-1] == list("gfedcb")
    assert opened.run("[...document.querySelectorAll('table')].length") == 4
    others = "[...document.querySelectorAll('th[aria-sort]')].map(th => th.ariaSort)"
    assert opened.run(others).count("none") == 2 * 16 - 1


def test_figures_zoom_move_and_come_back(opened):
    width = "document.querySelector('.stage img').getBoundingClientRect().width"
    left = "document.querySelector('.stage img').getBoundingClientRect().x"
    opened.run("document.querySelector('.figure-button').focus()")
    opened.key("Enter", 13)
    opened.until("document.querySelector('#lightbox').open")
    before, at = opened.run(width), opened.run(left)
    opened.mouse("mouseWheel", 400, 300, deltaX=0, deltaY=-400)
    opened.until(f"{width} > 1.5 * {before}")
    zoomed, at = opened.run(width), opened.run(left)
    # What was under the pointer is still there.
    opened.mouse("mousePressed", 400, 300, button="left", clickCount=1)
    opened.mouse("mouseMoved", 460, 300, button="left", buttons=1)
    opened.mouse("mouseReleased", 460, 300, button="left", clickCount=1)
    assert opened.until(f"{left} > {at} && {left}") == pytest.approx(at + 60, abs=1)
    opened.key("+", 187)
    opened.until(f"{width} > 1.2 * {zoomed}")
    for count in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            opened.mouse(kind, 640, 300, button="left", clickCount=count)
    assert opened.until(f"{width} < {zoomed} && {width}") == pytest.approx(before)
    opened.key("Escape", 27)
    opened.until("!document.querySelector('#lightbox').open")


def test_two_fingers_zoom_figures(opened):
    width = "document.querySelector('.stage img').getBoundingClientRect().width"
    opened.send("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    opened.click(".figure-button")
    opened.until("document.querySelector('#lightbox').open")
    before = opened.run(width)
    for kind, apart in (("touchStart", 50), ("touchMove", 75), ("touchMove", 100)):
        fingers = [{"x": 640 + side * apart, "y": 300, "id": side + 1} for side in (-1, 1)]
        opened.send("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)
    opened.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    opened.send("Emulation.setTouchEmulationEnabled", enabled=False)
    assert opened.until(f"{width} > {before} && {width}") == pytest.approx(2 * before, rel=0.05)
    opened.click("#lightbox [data-do=close]")
    opened.until("!document.querySelector('#lightbox').open")


def car(index):
    return f"document.querySelectorAll('.drive .vehicle')[{index}].getAttribute('transform')"


SLIDER = "Number(document.querySelector('{} input[type=range]').value)"


def test_cars_move_and_can_be_paused(opened):
    start = opened.run(car(0))
    opened.click(".drive .controls button")
    opened.until(f"{SLIDER.format('.drive')} < 1.9 && {SLIDER.format('.drive')} > 0.05")
    moving = opened.run(car(0))
    assert moving != start
    opened.until(f"{car(0)} !== {json.dumps(moving)}")
    opened.click(".drive .controls button")
    still = opened.run(car(0))
    opened.run("new Promise(done => setTimeout(done, 150))")
    assert opened.run(car(0)) == still
    # By hand: at 1 s, the path is where it is.
    opened.run("(() => { const s = document.querySelector('.drive input[type=range]');"
               "s.value = 1; s.dispatchEvent(new Event('input')); })()")  # fmt: skip
    place = [float(x) for x in re.match(r"translate\((\S+) (\S+)\)", opened.run(car(0))).groups()]
    assert place == pytest.approx(scene()["rows"][0]["paths"][0][4][:2])
    opened.click(".drive .controls button")
    opened.until(f"{SLIDER.format('.drive')} === 2")  # it stops by itself at the end
    assert "Play" in opened.run("document.querySelector('.drive .controls button').textContent")


def test_rows_and_paths_can_be_chosen(opened):
    seen = (
        "[...document.querySelector('.drive').querySelectorAll('.vehicle')]"
        ".filter(mark => mark.getBoundingClientRect().width > 0).length"
    )
    hits = seen.replace(".vehicle", ".hit")
    assert (opened.run(seen), opened.run(hits)) == (6, 1)
    opened.click(".drive .chips label")
    assert (opened.run(seen), opened.run(hits)) == (3, 0)
    opened.run("(() => { const s = document.querySelector('.drive select');"
               "s.value = 1; s.dispatchEvent(new Event('change')); })()")  # fmt: skip
    assert opened.run(seen) == 1
    opened.click(".drive .chips button")
    assert (opened.run(seen), opened.run(hits)) == (2, 1)


def test_iterates_play_from_guess_to_plan(opened):
    now = "document.querySelector('.iterates .now').getAttribute('points')"
    text = "document.querySelector('.iterates .readout').textContent"
    last = opened.run(now)
    assert opened.run(text) == "Iterate 2 of 2: effort 1.000, obstacles 0.250"
    opened.click(".iterates .controls button")
    opened.until(f"{text} === 'Initial guess'")
    assert opened.run(now) != last
    opened.until(f"{SLIDER.format('.iterates')} === 2")
    assert opened.run(now) == last


@pytest.mark.parametrize("width", [320, 390, 768, 1280, 1920])
def test_no_width_needs_sideways_scrolling(opened, width):
    opened.size(width, 800)
    assert opened.run("document.documentElement.scrollWidth") <= width
    inside = opened.run(
        "[...document.querySelectorAll('.player, .table, figure, .notes')]"
        ".map(e => e.getBoundingClientRect().right)"
    )
    assert max(inside) <= width


def test_the_theme_follows_the_system_and_the_button(opened):
    colour = "getComputedStyle(document.body).backgroundColor"
    light = opened.run(colour)
    scheme = [{"name": "prefers-color-scheme", "value": "dark"}]
    opened.send("Emulation.setEmulatedMedia", features=scheme)
    dark = opened.run(colour)
    assert dark != light
    opened.click("#theme")  # from the system's to light
    assert opened.run(colour) == light
    opened.send("Emulation.setEmulatedMedia", features=[])
    opened.click("#theme")
    assert opened.run(colour) == dark
    opened.send("Emulation.setEmulatedMedia", media="print")
    assert opened.run(colour) not in (light, dark)  # paper is white
    opened.send("Emulation.setEmulatedMedia", media="")
    opened.click("#theme")


def test_it_can_be_read_without_scripts(opened, page):
    opened.send("Emulation.setScriptExecutionDisabled", value=True)
    opened.open(page)
    opened.send("Emulation.setScriptExecutionDisabled", value=False)
    visible = "e => e.checkVisibility()"
    assert opened.run(f"[...document.querySelectorAll('table, figure')].every({visible})")
    assert not opened.run(f"[...document.querySelectorAll('.animation, #theme')].some({visible})")
    assert opened.run("document.querySelectorAll('thead button').length") == 0
    assert opened.run("document.querySelector('.downloads a').href").startswith("data:text/csv")
