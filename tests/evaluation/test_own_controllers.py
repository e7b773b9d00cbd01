"""What a user may bring, by name: each kind drives as it should, each mistake is named at once."""

import pickle
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from slipcar.evaluation import compare, evaluate, sample_paths
from slipcar.evaluation.own.adapters import ActionFunction, StateFunction, per_row
from slipcar.evaluation.own.as_controller import as_controller
from slipcar.evaluation.own.load import (
    entry_points,
    load_controller,
    load_maker,
    split_name,
)

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_controller.py"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder; what is imported from it is forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def write(folder, name, code):
    path = folder / name
    path.write_text(textwrap.dedent(code))
    return path


# ------------------------------------------------------------------ functions of (t, x)


def push(t, x):
    return np.stack([1.0 - 0.5 * t - 0.1 * x[:, 3], 0.3 * np.sin(x[:, 2]) + 0.2], axis=-1)


def test_a_function_of_time_and_state_drives_by_its_own_controls(paper):
    states, controls = sample_paths(as_controller(push, paper), paper, 5, seed=3)
    for k in range(paper.nodes - 1):
        # What it sees travels as float32.
        np.testing.assert_allclose(
            controls[:, k], push(paper.times[k], states[:, k]), atol=1e-5, rtol=1e-5
        )
    assert np.ptp(controls[:, -1, 1]) > 1e-4  # the paths differ, and so do their controls


def test_controls_beyond_the_bounds_are_clipped(paper):
    controller = as_controller(lambda t, x: np.array([9.0, -9.0]), paper)
    _, controls = sample_paths(controller, paper, 2)
    np.testing.assert_allclose(controls, np.broadcast_to([2.0, -4.0], controls.shape))


def test_row_by_row_is_the_same_as_all_at_once(paper):
    @per_row
    def alone(t, x):
        return [1.0 - 0.5 * t - 0.1 * x[3], 0.3 * np.sin(x[2]) + 0.2]

    one, all_ = as_controller(alone, paper), as_controller(push, paper)
    assert (one.rows, all_.rows) == (16, 1024)
    assert one.per_row
    assert not all_.per_row
    observed = np.random.default_rng(0).normal(size=(7, 6)).astype(np.float32)
    observed[:, 5] = [0.0, 0.125, 0.0, 5.0, 2.5, 2.5, 0.125]  # cars of a fleet at different times
    together = all_.predict(observed)[0]
    np.testing.assert_allclose(one.predict(observed)[0], together, atol=1e-15)
    np.testing.assert_allclose(one.predict(observed[2])[0], together[2], atol=1e-15)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda t, x: np.zeros((2, len(x))), r"stack them on the last axis"),
        (lambda t, x: x[:, 3], r"must return shape \(3, 2\), or \(2,\) for all, not \(3,\)"),
        (lambda t, x: None, r"must return an array of controls .*, not a NoneType"),
        (lambda t, x: "left", r"not a str"),
        (lambda t, x: [[1.0, 2.0], [3.0]], r"must return an array of controls"),
        (lambda t, x: np.where(t < 1.0, np.nan, 0.0) * x[:, :2], "returned nan; controls must be"),
        (lambda t, x: x[:, :2] if x[:, 2] > 0.0 else 0.0, "numpy.where, or mark it with .*per_row"),
        (lambda t, x: {}["key"], "failed on the first step: KeyError: 'key'"),
        (lambda: None, r"takes no parameters: a controller is a function of \(t, x\)"),
        (lambda t, x, y: x, r"takes \['t', 'x', 'y'\]"),
        (lambda t, x, *, gain: x, r"needs \['gain'\] by keyword"),
        (3.0, "is a float and no controller"),
        (None, "is None"),
        ("words", "is a str and no controller"),
        (dict, "does not say what parameters it takes"),
        (len, "must return an array of actions|discrete"),
    ],
)
def test_what_cannot_drive_is_refused_by_name(paper, function, message):
    with pytest.raises(ValueError, match=rf"mine.*({message})"):
        as_controller(function, paper, "mine")


# ------------------------------------------------------------------ objects, classes, factories


class Scaled:
    """Needs the scenario."""

    def __init__(self, scenario):
        self.goal = scenario.goal

    def __call__(self, t, x):
        return 0.1 * (self.goal[:2] - x[:, :2])


class Still:
    """Needs nothing."""

    def __init__(self, strength=0.5):
        self.strength = strength

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.full((len(observation), 2), self.strength), state


def test_classes_and_factories_are_called_with_the_scenario_where_they_need_it(paper):
    def factory(scenario):
        return Scaled(scenario)

    expected = sample_paths(as_controller(Scaled(paper), paper), paper, 3)[0]
    for thing in (Scaled, factory):
        np.testing.assert_array_equal(
            sample_paths(as_controller(thing, paper), paper, 3)[0], expected
        )
    assert as_controller(Still, paper).strength == 0.5
    still = Still(0.25)
    assert as_controller(still, paper) is still


@pytest.mark.parametrize(
    ("thing", "message"),
    [
        (type("Two", (), {"__init__": lambda self, a, b: None}), r"needs \['a', 'b'\] to be made"),
        (type("Torn", (), {"__init__": lambda self, scenario: 1 / 0}), "ZeroDivisionError"),
        (lambda scenario: None, "is None: a factory must return"),
        (
            type("Bare", (), {"predict": lambda self, observation, **rest: observation[:, :2]}),
            r"must return \(action, state\), not ndarray",
        ),
        (type("Old", (), {"predict": lambda self, observation: None}), "unexpected keyword"),
        (
            type("Odd", (Still,), {"rows": 3}),
            "rows must divide 1024, not 3",
        ),
    ],
)
def test_objects_that_cannot_drive_are_refused_by_name(paper, thing, message):
    with pytest.raises(ValueError, match=f"mine.*{message}"):
        as_controller(thing, paper, "mine")


# ------------------------------------------------------------------ fingerprints


def define(code, **names):
    space = {"np": np, **names}
    exec(textwrap.dedent(code), space)
    return space["f"]


def told(function, paper):
    return StateFunction(function, paper).fingerprint()


def test_a_fingerprint_is_of_the_behaviour(paper):
    closed = """
    def make(gain):
        def f(t, x):
            return gain * x[:, :2]
        return f
    f = make(GAIN)
    """
    one, same, other = (told(define(closed, GAIN=g), paper) for g in (1.0, 1.0, 2.0))
    assert one is not None
    assert one == same != other
    table = "def f(t, x): return TABLE[0] * x[:, :2] + helper(t)\ndef helper(t): return {}"
    a = told(define(table.format("0.0"), TABLE=np.arange(3.0)), paper)
    assert a is not None
    assert a == told(define(table.format("0.0"), TABLE=np.arange(3.0)), paper)
    assert a != told(define(table.format("0.0"), TABLE=np.arange(3.0) + 1e-9), paper)
    assert a != told(define(table.format("0.1"), TABLE=np.arange(3.0)), paper)  # a function it uses
    assert told(push, paper) != told(push, paper.replace(control_bounds=(1.0, 4.0)))


def test_what_cannot_be_followed_has_no_fingerprint(paper):
    rng = np.random.default_rng(0)
    assert told(lambda t, x: rng.normal(size=(len(x), 2)), paper) is None
    assert told(lambda t, x: np.random.normal(size=(len(x), 2)), paper) is None  # noqa: NPY002
    draw = rng.normal
    assert told(lambda t, x: draw(size=(len(x), 2)), paper) is None


def test_stored_rows_of_a_function_are_reused_until_it_changes(paper, tmp_path):
    def run(gain):
        function = define("def f(t, x): return GAIN * x[:, :2] + 0.1", GAIN=gain)
        rows = {"mine": as_controller(function, paper)}
        return compare(rows, paper, 50, folder=tmp_path, progress=False).reused

    assert [run(1.0), run(1.0), run(2.0)] == [(), ("mine",), ()]


# ------------------------------------------------------------------ by name


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mine=a.b:c", ("mine", "a.b:c")),
        ("a.b:c", (None, "a.b:c")),
        ("my row = model.zip", ("my row", "model.zip")),
        ("runs/lr=0.1/model.zip", (None, "runs/lr=0.1/model.zip")),
        ("x=runs/lr=0.1/model.zip", ("x", "runs/lr=0.1/model.zip")),
    ],
)
def test_a_name_stands_before_the_first_equals(text, expected):
    assert split_name(text) == expected


@pytest.mark.parametrize("text", ["", "=a:b", "name=", " = "])
def test_empty_names_are_refused(text):
    with pytest.raises(ValueError, match=r"\[NAME=\]module:object"):
        split_name(text)


def test_modules_of_the_current_folder_and_files(folder, paper):
    write(folder, "gains_of_mine.py", "GAIN = 0.25\n")
    code = """
    import numpy as np
    from gains_of_mine import GAIN

    def controller(t, x):
        return GAIN * np.cos(x[:, 2:4])

    class Box:
        inner = staticmethod(controller)
    """
    write(folder, "drivers_of_mine.py", code)
    (folder / "deep").mkdir()
    write(folder / "deep", "drivers_of_mine.py", code.replace("GAIN *", "2.0 * GAIN *"))
    found = dict(
        load_controller(text, paper)
        for text in (
            "drivers_of_mine:controller",
            "inner=drivers_of_mine:Box.inner",
            "file=drivers_of_mine.py:controller",
            "deep=deep/drivers_of_mine.py:controller",
        )
    )
    assert list(found) == ["drivers_of_mine:controller", "inner", "file", "deep"]
    total = {name: evaluate(c, paper, 20).effort for name, c in found.items()}
    assert total["inner"] == total["file"] == total["drivers_of_mine:controller"] > 0.0
    assert total["deep"] == pytest.approx(4.0 * total["file"], rel=0.2)
    prints = {name: c.fingerprint() for name, c in found.items()}
    assert None not in prints.values()
    assert prints["file"] == prints["inner"] != prints["deep"]


def test_what_is_loaded_travels_to_workers_that_cannot_import_it(folder, paper):
    cloudpickle = pytest.importorskip("cloudpickle")
    write(folder, "far_helper.py", "def half(x):\n    return 0.5 * x\n")
    code = (
        "from far_helper import half\n\ndef controller(t, x):\n    return half(x[:, 3:5]) + 0.1\n"
    )
    write(folder, "far_driver.py", code)
    _, controller = load_controller("far_driver.py:controller", paper)
    sent = cloudpickle.dumps(controller)
    for name in [name for name in sys.modules if name.startswith("far_")]:
        del sys.modules[name]
    for file in folder.glob("far_*.py"):
        file.unlink()
    back = pickle.loads(sent)
    assert evaluate(back, paper, 10).total == evaluate(controller, paper, 10).total


def test_the_example_is_driven_by_its_path(paper):
    name, controller = load_controller(f"mine={EXAMPLE}:controller", paper)
    assert name == "mine"
    result = evaluate(controller, paper, 500)
    straight = evaluate(as_controller(lambda t, x: np.array([0.3, 0.0]), paper), paper, 500)
    assert result.total < 0.1 * straight.total
    assert result.position_rms < 0.15


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nowhere_at_all:controller", "no module 'nowhere_at_all', neither installed nor in"),
        ("nowhere_at_all.inner:controller", r"no module .* such as folder/nowhere_at_all/inner.py"),
        ("nowhere.py:controller", "no file 'nowhere.py'"),
        ("folder/nowhere:controller", "no file 'folder/nowhere'"),
        ("fine.py:driver", r"fine.py:driver: .* has no 'driver'; it has \['np', 'controller'\]"),
        ("broken.py:controller", "importing broken.py raised ZeroDivisionError"),
        ("script.py:controller", "importing script.py raised SystemExit: 3"),
        ("missing.py:controller", "importing missing.py raised ModuleNotFoundError: .*not_there"),
        ("wrong.py:controller", r"wrong:controller\(t, x\) .* must return shape"),
        ("no word:controller", "neither a module's name nor a .py file"),
        ("driver_word", r"unknown controller 'driver_word'.*entry point of slipcar.controllers"),
        ("fine.zip", "fine.zip is no model of Stable-Baselines3"),
        ("fine.npz", "fine.npz"),
    ],
)
def test_mistakes_in_names_are_explained(folder, paper, text, message):
    write(folder, "fine.py", "import numpy as np\ndef controller(t, x): return x[:, :2]\n")
    write(folder, "broken.py", "1 / 0\n")
    write(folder, "script.py", "raise SystemExit(3)\n")
    write(folder, "missing.py", "import not_there_at_all\n")
    write(folder, "wrong.py", "def controller(t, x): return x\n")
    write(folder, "fine.zip", "no zip")
    write(folder, "fine.npz", "no npz")
    with pytest.raises(ValueError, match=message):
        load_controller(text, paper)


def test_stored_plans_by_file(folder, paper):
    from slipcar.planner import Feedback, OpenLoop, plan

    found = plan(paper)
    found.save(folder / "open.npz")
    found.replace(gains=Feedback(found).plan.gains).save(folder / "closed.npz")
    for text, expected in (("open.npz", OpenLoop(found)), ("closed.npz", Feedback(found))):
        name, controller = load_controller(text, paper)
        assert name == text[:-4]
        assert controller.fingerprint() == expected.fingerprint()
    prints = {load_maker(text)[1].fingerprint() for text in ("open.npz", "closed.npz")}
    assert len(prints) == 2
    assert None not in prints


def test_stored_policies_by_file(folder, paper):
    from slipcar.baselines import load_policy, save_policy

    policy = load_policy()
    save_policy(policy, folder / "learned.safetensors")
    name, controller = load_controller("learned.safetensors", paper)
    assert name == "learned"
    assert controller.fingerprint() == policy.fingerprint()


def test_makers_make_one_for_every_world(folder, paper):
    code = """
    GAIN = 1.0

    def controller(scenario):
        return lambda t, x: GAIN * (scenario.goal[:2] - x[:, :2])
    """
    write(folder, "maker_of_mine.py", code)
    name, maker = load_maker("mine=maker_of_mine.py:controller")
    assert name == "mine"
    other = paper.replace(goal=(1.0, 3.0, 0.0, 0.0, 0.0))
    near, far = (maker(world).predict(np.zeros(6))[0] for world in (other, paper))
    np.testing.assert_allclose(near * paper.action_scale, [1.0, 3.0])
    np.testing.assert_allclose(far * paper.action_scale, [2.0, 3.0])  # 2.2 is beyond the bounds
    told = maker.fingerprint()
    assert told is not None
    write(folder, "maker_of_mine.py", code.replace("GAIN = 1.0", "GAIN = 0.5"))
    assert load_maker("maker_of_mine.py:controller")[1].fingerprint() != told


# ------------------------------------------------------------------ entry points


def install(folder, monkeypatch, *, name="mypackage", points, code):
    """A distribution as pip leaves it: a module and its .dist-info."""
    write(folder, f"{name}.py", code)
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[slipcar.controllers]\n{points}\n")
    monkeypatch.syspath_prepend(str(folder))


def test_installed_packages_offer_controllers_by_name(folder, paper, monkeypatch):
    code = "def steer(t, x):\n    return 0.5 - 0.1 * x[:, 3:5]\n"
    install(folder, monkeypatch, points="steady = mypackage:steer", code=code)
    assert "steady" in entry_points()
    name, controller = load_controller("steady", paper)
    assert name == "steady"
    assert evaluate(controller, paper, 10).effort > 0.0
    assert load_controller("other=steady", paper)[0] == "other"
    with pytest.raises(ValueError, match=r"installed packages offer \[.*'steady'"):
        load_controller("stead", paper)


def test_entry_points_that_clash_or_break_are_named(folder, paper, monkeypatch):
    install(folder, monkeypatch, name="firstone", points="twice = firstone:f", code="f = 1\n")
    install(folder, monkeypatch, name="secondone", points="torn = nothing_here:g", code="")
    with pytest.raises(ValueError, match=r"'torn' .*nothing_here:g of secondone.* cannot be"):
        load_controller("torn", paper)
    install(folder, monkeypatch, name="thirdone", points="twice = thirdone:f", code="f = 1\n")
    with pytest.raises(ValueError, match="two installed packages offer a controller 'twice'"):
        load_controller("twice", paper)


def test_functions_of_observations_see_what_they_ask_for(paper):
    seen = []

    def features(observation):
        seen.append(observation.shape)
        return np.zeros((len(observation), 2))

    def states(observation):
        seen.append(observation.shape)
        return np.zeros((len(observation), 2))

    states.observation, states.obstacle_slots = "state", 4
    for function, size in ((features, 12), (states, 22)):
        seen.clear()
        controller = as_controller(function, paper)
        assert isinstance(controller, ActionFunction)
        assert {shape[1] for shape in seen} == {size}
        assert controller.predict(np.zeros(size))[0].shape == (2,)
    states.observation = "pictures"
    with pytest.raises(ValueError, match="unknown observation 'pictures'"):
        as_controller(states, paper)
