"""The live page in a real browser: what is dragged, typed and clicked, and what is then seen."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("aiohttp", reason='aiohttp is not installed: pip install "slipcar[live]"')
playwright = pytest.importorskip("playwright.sync_api")
NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
if CHROMIUM is None:
    pytest.skip("no chromium", allow_module_level=True)

BOAT = Path(__file__).parents[2] / "examples" / "boat.py"


@pytest.fixture(scope="module")
def server():
    """Address and process of a server of its own."""
    command = [sys.executable, "-m", "slipcar.evaluation", "live", "--port", "0"]
    process = subprocess.Popen(
        [*command, "--problem", f"{BOAT}:Boat"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    line = process.stdout.readline()
    if not line.startswith("http"):
        raise RuntimeError(line + process.stdout.read())
    yield line.split()[0], process
    process.terminate()
    assert process.wait(20) == 0
    assert process.stdout.read() == ""


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture
def tab(browser, server):
    """Opens tabs; an error in the page's script fails the test."""
    errors, pages = [], []

    def opened(link="", **options):
        page = browser.new_page(viewport={"width": 1100, "height": 800}, **options)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(server[0] + link)
        page.wait_for_selector("#numbers dd")
        pages.append(page)
        return page

    yield opened
    for page in pages:
        page.close()
    assert not errors


def numbers(page):
    """Name -> value of the list of numbers."""
    read = "[...document.querySelectorAll('#numbers dt, #numbers dd')].map((e) => e.textContent)"
    texts = page.evaluate(read)
    return dict(zip(texts[::2], texts[1::2], strict=True))


def until(condition, seconds=30.0):
    """What a condition gives once it gives something."""
    ends = time.monotonic() + seconds
    while not (got := condition()) and time.monotonic() < ends:
        time.sleep(0.05)
    assert got
    return got


def middle(page, key):
    box = page.locator(f'[data-key="{key}"]').bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def settled(page):
    """Wait until all that was asked for is on the canvas."""
    page.wait_for_timeout(100)
    until(lambda: page.evaluate("slipcarLive.settled"))


def drag(page, key, dx, dy, *, drop=True):
    x, y = middle(page, key)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + dx, y + dy, steps=8)
    if drop:
        page.mouse.up()


def shown(page):
    """What the canvas shows, once nothing is under way."""
    settled(page)
    return page.evaluate("document.getElementById('canvas').toDataURL()")


def other_than(page, total):
    return until(lambda: numbers(page).get("total") != total and numbers(page))


def test_a_dragged_obstacle_changes_plan_and_picture_and_undo_brings_them_back(tab):
    page = tab()
    picture = shown(page)
    before = numbers(page)
    drag(page, "obstacles[0]", -60, 40)
    after = other_than(page, before["total"])
    assert shown(page) != picture
    assert float(after["total"]) > 0
    page.click("#undo")
    assert shown(page) == picture
    assert numbers(page)["total"] == before["total"]


def test_goal_and_start_and_headings_can_be_dragged(tab):
    page = tab()
    for key in ("goal", "start", "goal-heading", "start-heading"):
        total = numbers(page)["total"]
        drag(page, key, 15, -25)
        other_than(page, total)


def test_everything_goes_by_keyboard(tab):
    page = tab()
    handle = page.locator('[data-key="obstacles[1]"]')
    handle.focus()
    for key in ("ArrowRight", "Shift+ArrowUp", "+", "-"):
        label, total = handle.get_attribute("aria-label"), numbers(page)["total"]
        page.keyboard.press(key)
        other_than(page, total)
        assert key in "+-" or handle.get_attribute("aria-label") != label
    count = page.locator(".handle.obstacle").count()
    page.keyboard.press("Delete")
    until(lambda: page.locator(".handle.obstacle").count() == count - 1)
    page.keyboard.press("Control+z")
    until(lambda: page.locator(".handle.obstacle").count() == count)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1100, 390])
def test_no_violation_of_accessibility(tab, scheme, width):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    page = tab(color_scheme=scheme, bypass_csp=True)
    page.set_viewport_size({"width": width, "height": 800})
    page.click("text=risk ≤ δ")
    page.evaluate("document.getElementById('horizon').value = 0")
    page.locator("#horizon").dispatch_event("input")
    until(lambda: "horizon must" in page.inner_text("#horizon-error"))
    result = axe.run(page)
    assert result.violations_count == 0, result.generate_report()


def test_a_finger_drags_on_a_phone(tab):
    page = tab(has_touch=True, is_mobile=True)
    total = numbers(page)["total"]
    x, y = middle(page, "obstacles[0]")
    touch = page.context.new_cdp_session(page)
    for kind, off in (("touchStart", 0), ("touchMove", 20), ("touchMove", 50), ("touchEnd", 50)):
        points = [] if kind == "touchEnd" else [{"x": x - off, "y": y}]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    other_than(page, total)
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_an_obstacle_is_added_resized_and_removed_by_pointer(tab):
    page = tab()
    count = page.locator(".handle.obstacle").count()
    page.click("text=Add an obstacle")
    until(lambda: page.locator(".handle.obstacle").count() == count + 1)
    drag(page, f"obstacles[{count}]", 120, 60)
    for button in ("#larger", "#smaller"):
        picture = shown(page)
        page.click(button)
        assert shown(page) != picture
    page.click("#remove")
    until(lambda: page.locator(".handle.obstacle").count() == count)
    assert page.locator("#obstacle-row").is_hidden()


def test_modes_differ_and_a_risk_is_verified(tab):
    page = tab()
    total = numbers(page)["total"]
    assert float(numbers(page)["corrections"]) > 0
    page.click("text=open loop")
    opened = other_than(page, total)
    assert float(opened["corrections"]) == 0
    page.click("text=risk ≤ δ")
    found = until(lambda: "price found" in numbers(page) and numbers(page))
    assert any("20000 fresh paths" in name for name in found)
    page.click("text=Python")
    assert "risk=0.01" in page.input_value("#text")


def test_a_policy_is_shown_beside_it(tab):
    page = tab()
    page.select_option("#policy", index=1)
    name = page.input_value("#policy")
    until(lambda: name in numbers(page))


def test_the_car_drives_while_an_obstacle_is_dragged(tab):
    page = tab()
    page.click("text=receding horizon")
    page.evaluate("document.getElementById('horizon').value = 3")
    page.locator("#horizon").dispatch_event("input")
    page.click("#drive")
    until(lambda: "step 3 of" in page.inner_text("#drive-state"))
    drag(page, "obstacles[1]", 30, 10)
    until(lambda: "m off" in page.inner_text("#drive-state"))
    assert page.inner_text("#drive") == "Drive"


def test_what_is_wrong_is_said_where_it_is_wrong_and_the_page_goes_on(tab):
    page = tab()
    total = numbers(page)["total"]
    at, to = middle(page, "obstacles[3]"), middle(page, "start")
    drag(page, "obstacles[3]", to[0] - at[0] + 5, to[1] - at[1], drop=False)
    until(lambda: "lies over the start" in page.inner_text("#bubble"))
    assert page.locator(".handle.bad").get_attribute("data-key") == "obstacles[3]"
    page.mouse.move(*at, steps=4)
    page.mouse.up()
    until(lambda: page.locator(".handle.bad").count() == 0)
    until(lambda: numbers(page)["total"] == total)
    page.evaluate("document.getElementById('horizon').value = 0")
    page.locator("#horizon").dispatch_event("input")
    until(lambda: "horizon must be" in page.inner_text("#horizon-error"))
    page.click("#undo") if page.locator("#undo").is_enabled() else page.click("#reset")
    until(lambda: not page.inner_text("#horizon-error"))


def test_two_tabs_do_not_disturb_each_other(tab):
    one, two = tab(), tab()
    settled(two)
    picture, total = shown(two), numbers(two)["total"]
    drag(one, "obstacles[0]", -60, 40)
    other_than(one, total)
    assert (shown(two), numbers(two)["total"]) == (picture, total)


def test_a_link_shows_the_same_again(tab):
    page = tab()
    drag(page, "obstacles[0]", -60, 40)
    shown(page)
    page.click("text=Link")
    link = page.input_value("#text").partition("#")[2]
    assert shown(tab("#" + link)) == shown(page)
    broken = tab("#%7B%22world")
    assert "could not be read" in broken.inner_text("#banner")


def test_python_and_json_that_are_copied_give_the_plan_that_is_seen(tab):
    from slipcar.envs import Scenario

    page = tab()
    drag(page, "obstacles[0]", -60, 40)
    shown(page)
    page.click("text=JSON")
    world = json.loads(page.input_value("#text"))
    page.click("text=Python")
    scope = {}
    exec(page.input_value("#text"), scope)
    assert scope["s"] == Scenario.from_dict(world)
    assert f"{scope['p'].expected.total:.3f}" == numbers(page)["total"]


def test_a_system_of_ones_own_is_dragged_in_its_plane(tab):
    page = tab()
    page.select_option("#world", "system:Boat")
    until(lambda: page.locator(".handle").count() == 1)
    total = numbers(page)["total"]
    drag(page, "start", 40, -30)
    other_than(page, total)


def test_a_tab_that_goes_away_in_a_drag_leaves_a_server_that_serves_and_rests(tab, server):
    process = server[1]
    page = tab()
    drag(page, "obstacles[0]", -60, 40, drop=False)
    page.close()
    after = tab()
    shown(after)

    def used():
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    if Path("/proc").is_dir():
        before = used()
        time.sleep(2.0)
        assert used() - before < 0.1  # seconds of the processor in two: it rests


def test_a_hard_world_is_dragged_by_quick_plans_and_planned_whole_at_rest(tab):
    page = tab()
    page.evaluate("document.getElementById('horizon').value = 1")  # hardly time to get there
    page.locator("#horizon").dispatch_event("input")
    page.select_option("#world", "slalom")
    page.click("text=open loop")
    for _ in range(3):
        drag(page, "obstacles[1]", -30, 20)
    settled(page)
    page.click("text=Python")
    assert "starts=1" not in page.input_value("#text")


def test_a_server_that_comes_back_is_found_again(browser):
    def started(port):
        command = [sys.executable, "-m", "slipcar.evaluation", "live", "--port", str(port)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, bufsize=1)
        return process, process.stdout.readline().split()[0]

    process, address = started(0)
    page = browser.new_page()
    try:
        page.goto(address)
        page.wait_for_selector("#numbers dd")
        process.terminate()
        process.wait(20)
        until(lambda: "does not answer" in page.inner_text("#banner"))
        process, _ = started(address.rstrip("/").rpartition(":")[2])
        total = numbers(page)["total"]
        drag(page, "obstacles[0]", -60, 40)
        other_than(page, total)
        assert page.locator("#banner").is_hidden()
    finally:
        page.close()
        process.terminate()
        process.wait(20)
