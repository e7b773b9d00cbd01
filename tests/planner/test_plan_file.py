"""Plans on disk: what is written comes back, what is damaged says so."""

import dataclasses
import importlib.metadata
import json
import zipfile

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Feedback, OpenLoop, Plan, Status, plan
from slipcar.planner import plan as plan_function


@pytest.fixture(scope="module")
def planned():
    return plan(Scenario.named("paper"), variance_weight=2.0)


@pytest.fixture
def registered(monkeypatch):
    """The package's entry point, as an installation declares it."""
    entry = importlib.metadata.EntryPoint(
        "Scenario", "slipcar.envs.scenario:Scenario", "slipcar.problems"
    )
    module = importlib.import_module("slipcar.planner.plan_file")
    monkeypatch.setattr(
        module, "entry_points", lambda group: [entry] if group == "slipcar.problems" else []
    )


def same(a, b):
    if isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    elif isinstance(a, float) and np.isnan(a):
        assert np.isnan(b)
    else:
        assert a == b
        assert type(a) is type(b)


@pytest.mark.usefixtures("registered")
def test_a_plan_comes_back_as_it_was(planned, tmp_path):
    path = planned.save(tmp_path / "plan.npz")
    loaded = Plan.load(path)
    for field in dataclasses.fields(Plan):
        if field.name not in ("history", "multipliers"):
            same(getattr(planned, field.name), getattr(loaded, field.name))
    for field in dataclasses.fields(planned.multipliers):
        same(getattr(planned.multipliers, field.name), getattr(loaded.multipliers, field.name))
    assert len(loaded.history) == len(planned.history)
    for a, b in zip(planned.history, loaded.history, strict=True):
        for field in dataclasses.fields(a):
            same(getattr(a, field.name), getattr(b, field.name))
    assert loaded.status is Status.CONVERGED
    assert loaded.problem == Scenario.named("paper")
    assert OpenLoop(loaded).fingerprint() == OpenLoop(planned).fingerprint()
    assert Feedback(loaded).fingerprint() == Feedback(planned).fingerprint()
    obs = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 1.0], dtype=np.float32)
    np.testing.assert_array_equal(
        Feedback(loaded).predict(obs)[0], Feedback(planned).predict(obs)[0]
    )


@pytest.mark.usefixtures("registered")
def test_a_loaded_plan_starts_another(planned, tmp_path):
    loaded = Plan.load(planned.save(tmp_path / "plan"))
    again = plan(loaded.problem, variance_weight=2.0, guess=loaded)
    assert again.iterations <= 3


def test_gains_and_an_odd_outcome_come_back(planned, tmp_path):
    gains = np.random.default_rng(0).normal(size=(40, 2, 5))
    odd = planned.replace(
        gains=gains, status=Status.SOLVER_FAILED, message="a “reason”", history=(), iterations=0
    )
    loaded = Plan.load(odd.save(tmp_path / "odd.npz"))
    np.testing.assert_array_equal(loaded.gains, gains)
    assert loaded.status is Status.SOLVER_FAILED
    assert loaded.message == "a “reason”"
    assert loaded.history == ()


def test_infeasible_and_deterministic_plans_come_back(tmp_path):
    scenario = Scenario.named("open").replace(control_bounds=(0.1, 0.1), nodes=11)
    p = plan(scenario, variance_weight=0.0)
    loaded = Plan.load(p.save(tmp_path / "p"))
    assert loaded.status is Status.INFEASIBLE
    assert np.isnan(loaded.history[0].variance)
    assert loaded.history[-1].accepted is p.history[-1].accepted


def test_the_suffix_is_added_and_the_path_returned(planned, tmp_path):
    assert planned.save(tmp_path / "plan") == tmp_path / "plan.npz"
    assert planned.save(str(tmp_path / "plan.v2")) == tmp_path / "plan.v2.npz"
    assert sorted(f.name for f in tmp_path.iterdir()) == ["plan.npz", "plan.v2.npz"]


def test_saving_over_a_plan_replaces_it_whole(planned, tmp_path):
    path = planned.save(tmp_path / "plan.npz")
    planned.replace(effort=7.0).save(path)
    assert Plan.load(path).effort == 7.0
    assert [f.name for f in tmp_path.iterdir()] == ["plan.npz"]


def test_an_interrupted_save_leaves_the_old_plan(planned, tmp_path, monkeypatch):
    path = planned.save(tmp_path / "plan.npz")

    def full(*args, **kwargs):
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="no space left"):
        planned.replace(effort=7.0).save(path)
    assert Plan.load(path).effort == planned.effort
    assert [f.name for f in tmp_path.iterdir()] == ["plan.npz"]


def test_an_own_problem_is_forgotten_but_the_plan_is_not(tmp_path, registered):
    class Scenario:  # the name of a registered class, but not that class
        start, times, control_weight = np.zeros(1), np.linspace(0.0, 1.0, 5), np.eye(1)

        def drift(self, t, x, u):
            return u - x

        def diffusion(self, t, x):
            return np.full((*x.shape[:-1], 1, 1), 0.1)

        def terminal(self, x):
            return x - 1.0

        def to_json(self):
            return "{}"

    p = plan_function(Scenario())
    loaded = Plan.load(p.save(tmp_path / "p"))
    assert loaded.problem is None
    np.testing.assert_array_equal(loaded.controls, p.controls)
    obs = np.array([0.3, 0.25])
    np.testing.assert_array_equal(Feedback(loaded).predict(obs)[0], Feedback(p).predict(obs)[0])


class Cart:
    """x'' = u with a heavy correction, a one-sided bound and an angle that turns along."""

    start, times = np.array([0.0, 0.0, 0.1]), np.linspace(0.0, 2.0, 41)
    control_weight = 0.01 * np.eye(1)
    control_bounds = np.array([[-3.0], [4.0]])
    angles = (2,)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0], 0.5 * u[..., 0]], -1)

    def diffusion(self, t, x):
        return np.zeros((*x.shape[:-1], 3, 1))

    def terminal(self, x):
        return x[..., :2] - np.array([1.0, 0.0])


class Discs(Cart):
    """The same with controls in a ball."""

    control_bounds = None
    control_radius = 3.5


OBSERVATIONS = np.random.default_rng(0).normal(size=(200, 4)) * [2.0, 2.0, 9.0, 0.0] + [0, 0, 0, 1]


@pytest.mark.parametrize("kind", [Cart, Discs])
def test_a_saved_plan_of_an_own_problem_acts_as_it_did(kind, tmp_path):
    p = plan_function(kind(), variance_weight=0.0)
    loaded = Plan.load(p.save(tmp_path / "p"))
    again = Plan.load(loaded.save(tmp_path / "again"))  # what was kept is kept on
    for controller in (OpenLoop, Feedback):
        wanted = controller(p).predict(OBSERVATIONS)[0]
        for q in (loaded, again):
            np.testing.assert_array_equal(controller(q).predict(OBSERVATIONS)[0], wanted)
            assert controller(q).fingerprint() == controller(p).fingerprint()
    played = Feedback(p).predict(OBSERVATIONS)[0]
    low, high = (-3.0, 4.0) if kind is Cart else (-3.5, 3.5)
    assert played.min() == np.float32(low)  # the bounds are what the case is about
    assert played.max() == np.float32(high)


def test_what_a_file_cannot_keep_is_asked_for(tmp_path):
    class Scaled(Cart):
        def encode_control(self, u):
            return u / 4.0

    problem = Scaled()
    p = plan_function(problem, variance_weight=0.0)
    loaded = Plan.load(p.save(tmp_path / "p"))
    for controller in (OpenLoop, Feedback):
        with pytest.raises(ValueError, match=r"has encode_control, which its file cannot keep"):
            controller(loaded)
        given = controller(loaded.replace(problem=problem))
        wanted = controller(p).predict(OBSERVATIONS)[0]
        np.testing.assert_array_equal(given.predict(OBSERVATIONS)[0], wanted)
    with pytest.raises(ValueError, match=r"plan.replace\(problem=...\)"):
        loaded.certificate  # noqa: B018


def test_files_of_the_format_before_are_read_and_say_what_they_lack(planned, tmp_path, registered):
    def aged(header, arrays):
        header.update(format=3)
        for name in [name for name in arrays if name.startswith("actuation.")]:
            del arrays[name]

    rewrite(path := planned.save(tmp_path / "car"), aged)
    assert Feedback(Plan.load(path)).fingerprint() == Feedback(planned).fingerprint()
    own = plan_function(Cart(), variance_weight=0.0)
    rewrite(path := own.save(tmp_path / "own"), aged)
    old = Plan.load(path)
    np.testing.assert_array_equal(old.controls, own.controls)
    with pytest.raises(ValueError, match="knows neither its problem nor its control bounds"):
        Feedback(old)
    again = Feedback(old.replace(problem=Cart()))
    assert again.fingerprint() == Feedback(own).fingerprint()


@pytest.mark.parametrize("name", ["plan.v1", "plan", "plan.npz", ".plan", "plan.npz.old"])
def test_a_plan_is_found_by_the_name_it_was_given(planned, tmp_path, name):
    (tmp_path / "plan").mkdir()  # nothing that is there already is taken for it
    planned.save(tmp_path / name)
    assert Plan.load(tmp_path / name).effort == planned.effort
    assert len(list(tmp_path.iterdir())) == 2


def test_a_plan_that_was_renamed_is_read(planned, tmp_path):
    path = planned.save(tmp_path / "plan").rename(tmp_path / "plan.dat")
    assert Plan.load(path).effort == planned.effort


def test_what_cannot_be_written_is_named_as_it_was_asked_for(planned, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"cannot write .*missing/plan\.npz: .* no folder"):
        planned.save(tmp_path / "missing" / "plan.npz")
    (tmp_path / "taken.npz").mkdir()
    with pytest.raises(OSError, match=r"taken\.npz'?$") as refused:
        planned.save(tmp_path / "taken.npz")
    assert ".tmp" not in str(refused.value)
    assert [f.name for f in tmp_path.iterdir()] == ["taken.npz"]


def test_numpy_scalars_are_saved_as_the_numbers_they_are(tmp_path):
    s = Scenario.named("open")
    options = {
        "risk_price": np.arange(3)[1], "starts": np.int64(2), "feedback": np.bool_(True),
        "tolerance": np.float32(0.5), "max_iterations": np.uint8(30), "expected": np.bool_(False),
    }  # fmt: skip
    p = plan_function(s, **options)
    loaded = Plan.load(p.save(tmp_path / "p"))
    assert loaded.options == p.options
    kinds = (bool, int, float, str, type(None))
    assert all(type(value) in kinds for value in p.options.values())
    plain = {name: value.item() for name, value in options.items()}
    assert plan_function(s, **plain).options == p.options


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no plan at .*gone\.npz"):
        Plan.load(tmp_path / "gone.npz")
    with pytest.raises(FileNotFoundError, match=r"no plan at .*gone or .*gone\.npz"):
        Plan.load(tmp_path / "gone")


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_called_damaged(planned, tmp_path, keep):
    path = planned.save(tmp_path / "plan.npz")
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(ValueError, match="not a plan or is damaged"):
        Plan.load(path)


def test_flipped_bits_are_called_damage(planned, tmp_path):
    path = planned.save(tmp_path / "plan.npz")
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo("A.npy")
    data = bytearray(path.read_bytes())
    middle = info.header_offset + 60 + info.compress_size // 2
    data[middle : middle + 8] = bytes(b ^ 0xFF for b in data[middle : middle + 8])
    path.write_bytes(bytes(data))
    with pytest.raises(ValueError, match="damaged"):
        Plan.load(path)


def rewrite(path, change):
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(str(arrays["header"]))
    change(header, arrays)
    arrays["header"] = np.array(json.dumps(header))
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h, a: h.update(format=99), r"format 99; this version reads \[2, 3, 4\]"),
        (lambda h, a: h.pop("format"), "format None"),
        (lambda h, a: h.pop("effort"), "damaged.*effort"),
        (lambda h, a: h.update(status="FINE"), "damaged.*FINE"),
        (lambda h, a: a.pop("controls"), "damaged.*controls"),
        (lambda h, a: a.pop("multipliers.terminal"), "damaged.*terminal"),
        (lambda h, a: a.pop("history.step"), "damaged.*step"),
    ],
)
def test_a_file_that_lacks_something_says_what(planned, tmp_path, change, message):
    path = planned.save(tmp_path / "plan.npz")
    rewrite(path, change)
    with pytest.raises(ValueError, match=message):
        Plan.load(path)


def test_other_files_are_not_plans(tmp_path):
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    (tmp_path / "text.npz").write_text("not an archive")
    np.save(tmp_path / "array.npy", np.zeros(3))
    for name in ("other.npz", "text.npz", "array.npy"):
        with pytest.raises(ValueError, match="not a plan"):
            Plan.load(tmp_path / name)


def test_no_pickled_code_is_run(planned, tmp_path):
    path = planned.save(tmp_path / "plan.npz")
    with np.load(path, allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)
        arrays = dict(file)
    arrays["mean"] = np.array([{"a": 1}], dtype=object)
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match="damaged"):
        Plan.load(path)
