"""The law of a plan as numbers, JSON and C: what Python plays, in other languages."""

import ctypes
import dataclasses
import json
import shutil
import subprocess

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Feedback, OpenLoop, Plan, Status, plan
from slipcar.planner.c_code import c_files, write_c
from slipcar.planner.law import Law

CC = shutil.which("cc") or shutil.which("gcc")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-O2")
compiler = pytest.mark.skipif(CC is None, reason="no C compiler")


class Ball:
    """A point in the plane with its thrust in a ball, and in a box on one side."""

    start, times = np.array([0.0, 0.0, 1.0, 0.0]), np.linspace(0.0, 4.0, 21)
    control_weight, control_radius = np.eye(2), 0.9
    control_bounds = np.array([[-np.inf, -0.5], [np.inf, 0.8]])
    angles = (0, 3)

    def drift(self, t, x, u):
        return np.concatenate([x[..., 2:], u], axis=-1)

    def diffusion(self, t, x):
        return 0.05 * np.ones((*x.shape, 1))

    def terminal(self, x):
        return x - np.array([2.0, 1.0, 0.0, 0.0])


def ball_plan():
    p = plan(Ball())
    return p.replace(gains=Feedback(p).plan.gains)


@pytest.fixture(scope="module")
def paper():
    return plan(Scenario.named("paper"), feedback=True)


def points(law, count=3000, seed=1):
    """Times and states round the law's mean and far from it, and at its ends."""
    rng = np.random.default_rng(seed)
    K, _, n = law.gains.shape
    k = rng.integers(K, size=count)
    t = law.times[k] + (0.05 + 0.9 * rng.random(count)) * np.diff(law.times)[k]
    spread = np.where(rng.random((count, 1)) < 0.5, 0.1, 10.0)
    x = law.mean[k] + spread * rng.standard_normal((count, n))
    t[:3], x[:3] = (-5.0, law.times[0], law.times[-1] + 5.0), law.mean[[0, 0, -1]] + 0.01
    return t, x


def compiled(law, folder, name="law", *, float32=False):
    """The law's function, through a shared library."""
    write_c(law, folder, name, float32=float32)
    library = folder / f"{name}.so"
    source = folder / f"{name}.c"
    # Freestanding: not even the C library is there.
    command = [
        CC,
        *STRICT,
        "-ffreestanding",
        "-nostdlib",
        "-shared",
        "-fPIC",
        source,
        "-o",
        library,
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    real = ctypes.c_float if float32 else ctypes.c_double
    kind = np.float32 if float32 else np.float64
    function = getattr(ctypes.CDLL(str(library)), f"{name}_control")
    pointer = ctypes.POINTER(real)
    function.argtypes, function.restype = [real, pointer, pointer], ctypes.c_int

    def control(t, x):
        x, u = np.array(x, dtype=kind), np.empty(law.gains.shape[1], dtype=kind)
        k = function(t, x.ctypes.data_as(pointer), u.ctypes.data_as(pointer))
        return k, u.astype(float)

    return control


def planned(name):
    return ball_plan() if name == "ball" else plan(Scenario.named(name), feedback=True)


@pytest.mark.parametrize("name", [*Scenario.names(), "ball"])
@pytest.mark.parametrize("float32", [False, True])
@compiler
def test_c_plays_what_python_plays(name, float32, tmp_path):
    p = planned(name)
    law, play = Law.of(p), Feedback(p)
    tolerance = 1e-4 if float32 else 1e-9
    control = compiled(law, tmp_path, float32=float32)
    for t, x in zip(*points(law), strict=True):
        if float32:
            t, x = float(np.float32(t)), np.float32(x).astype(float)
        k, u = control(t, x)
        assert k == play._interval(t)
        np.testing.assert_allclose(u, play.control(t, x), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("float32", [False, True])
@compiler
def test_the_test_that_is_exported_passes_and_can_fail(paper, float32, tmp_path):
    write_c(Law.of(paper), tmp_path, "car", float32=float32)

    def tested():
        build = [CC, *STRICT, "car.c", "car_test.c", "-o", "car_test"]
        subprocess.run(build, cwd=tmp_path, check=True)
        return subprocess.run(["./car_test"], cwd=tmp_path, capture_output=True, text=True)

    done = tested()
    assert done.returncode == 0
    assert "200 cases" in done.stdout
    source = (tmp_path / "car.c").read_text()
    (tmp_path / "car.c").write_text(source.replace("planned[k][i] + sum", "planned[k][i] - sum"))
    assert tested().returncode == 1


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_the_header_is_c_plus_plus_too(paper, tmp_path):
    write_c(Law.of(paper), tmp_path, "car")
    (tmp_path / "main.cpp").write_text(
        '#include "car.h"\nint main() { double x[CAR_STATES] = {}, u[CAR_CONTROLS];'
        " return car_control(0.0, x, u); }\n"
    )
    subprocess.run([CC, "-c", "car.c"], cwd=tmp_path, check=True)
    build = ["g++", "-Wall", "-Werror", "main.cpp", "car.o", "-o", "m"]
    subprocess.run(build, cwd=tmp_path, check=True)
    assert subprocess.run(["./m"], cwd=tmp_path).returncode == 0


@compiler
def test_a_state_that_is_no_number_is_told_and_gets_the_plans_own_control(paper, tmp_path):
    control = compiled(Law.of(paper), tmp_path)
    good = paper.mean[3]
    for bad in (np.nan, np.inf, -np.inf, 1e300):
        x = good.copy()
        x[2] = bad
        k, u = control(paper.times[3], x)
        assert k == -1
        np.testing.assert_array_equal(u, paper.controls[3])
    k, u = control(np.nan, good)
    assert k == -1
    np.testing.assert_array_equal(u, paper.controls[0])


def test_json_gives_back_the_law(paper):
    for p in (paper, ball_plan()):
        law = Law.of(p)
        text = json.dumps(law.as_dict(), allow_nan=False)
        again = Law.from_dict(json.loads(text))
        for field in dataclasses.fields(Law):
            np.testing.assert_array_equal(getattr(again, field.name), getattr(law, field.name))


def test_the_laws_of_a_plan_are_its_controllers(paper):
    x = paper.mean[7] + 0.05
    nominal = plan(Scenario.named("paper"))
    for p, kind, player in (
        (paper, "planned", Feedback(paper)),
        (nominal, "lqr", Feedback(nominal)),
        (paper, "lqr", Feedback(paper.replace(gains=None))),
    ):
        expected = player.control(paper.times[7], x)
        np.testing.assert_allclose(Law.of(p, kind).control(paper.times[7], x), expected)
    planned = OpenLoop(nominal).control(paper.times[7], x)
    np.testing.assert_allclose(Law.of(nominal, "open-loop").control(paper.times[7], x), planned)


def test_a_law_comes_from_a_plans_file(paper, tmp_path):
    for p in (paper, ball_plan()):  # of one the file knows the problem, of the other its bounds
        loaded = Law.of(Plan.load(p.save(tmp_path / "plan.npz")))
        assert json.dumps(loaded.as_dict()) == json.dumps(Law.of(p).as_dict())


def test_what_cannot_be_exported_says_why(paper):
    nominal = plan(Scenario.named("paper"))
    with pytest.raises(ValueError, match="this plan has no gains: plan with feedback"):
        Law.of(nominal)
    free = plan(Scenario.named("paper").replace(control_bounds=None), feedback=True)
    with pytest.raises(ValueError, match="no bounds on its controls"):
        Law.of(free)
    law = Law.of(free, unbounded=True)
    assert law.as_dict()["upper"] == [None, None]
    assert "1.7976931348623157e+308" in c_files(law, "law")["law.c"]
    with pytest.raises(ValueError, match="only a converged plan is exported; this one ended"):
        Law.of(paper.replace(status=Status.MAX_ITERATIONS))
    with pytest.raises(ValueError, match="unknown law 'best'"):
        Law.of(paper, "best")
    with pytest.raises(ValueError, match="small letters"):
        c_files(Law.of(paper), "my law")
    huge = dataclasses.replace(Law.of(paper), controls=1e39 + Law.of(paper).controls)
    with pytest.raises(ValueError, match="too large for float32"):
        c_files(huge, "law", float32=True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "version 2"),
        ({"format": "x"}, "not a law"),
        ({"gains": None}, "'gains'"),
        ({"mean": [[0.0] * 5]}, "mean must have shape \\(40, 5\\)"),
        ({"times": [0.0] * 40 + ["x"]}, "times must be numbers"),
        ({"angles": [5]}, "angles must be components of 5 states"),
        ({"lower": [3.0, 0.0]}, "lower < upper"),
        ({"radius": -1.0}, "control_radius"),
    ],
)
def test_another_json_is_refused(paper, change, words):
    data = {**Law.of(paper).as_dict(), **change}
    if data["gains"] is None:
        del data["gains"]
    with pytest.raises(ValueError, match=words):
        Law.from_dict(data)
