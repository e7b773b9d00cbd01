"""Recursions: machine code computes what NumPy does, and what is kept on disk is never wrong."""

import functools
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from scipy.special import erfc

from slipcar.planner.trace import derivatives, emit, machine_code
from slipcar.planner.trace.elementwise import choose, larger, magnitude, positive_part
from slipcar.planner.trace.elementwise import erfc as traced_erfc
from slipcar.planner.trace.graph import Graph
from slipcar.planner.trace.recursion import (
    Field,
    NumberRows,
    Recursion,
    SymbolRows,
    Symmetric,
    in_numpy,
    pack,
)

if not machine_code.available():
    pytest.skip("needs llvmlite", allow_module_level=True)


def _code(recursions, layout, known=None, graph=None):
    text = emit.module(recursions, graph or Graph(), layout, known or {})
    return machine_code.Code(machine_code.compiled(text), [r.name for r in recursions])


def _run(code, name, layout, arrays, K):
    table = np.array([arrays[field].ctypes.data for field in layout], dtype=np.int64)
    code.short[name](K, table.ctypes.data)


def _arrays(layout, K, seed=0):
    rng = np.random.default_rng(seed)
    return {
        name: rng.normal(size=(1 if field.single else K + 1, field.width))
        for name, field in layout.items()
    }


def _both(recursion, layout, arrays, K, known=None, graph=None):
    """Copies of the arrays after machine code and after NumPy."""
    native, plain = ({k: v.copy() for k, v in arrays.items()} for _ in range(2))
    code = _code([recursion], layout, known, graph)
    _run(code, recursion.name, layout, native, K)
    in_numpy(recursion, layout, plain, K)
    return native, plain


def _agree(native, plain, rtol=1e-13):
    for name, value in plain.items():
        scale = np.abs(value[np.isfinite(value)]).max(initial=1.0)
        np.testing.assert_allclose(native[name], value, atol=rtol * scale, err_msg=name)


# --------------------------------------------------------------------------- made-up recursions


def _ascending():
    """x_{k+1} = A x_k + dt sin(x_k), and running sums and extremes of it."""
    layout = {
        "A": Field((3, 3)), "dt": Field(()), "x": Field((3,)), "sum": Field((2,), True),
        "first": Field((3,), True),
    }  # fmt: skip

    def start(rows):
        rows.write("first", 2.0 * rows["x"])
        return {"x": rows["x"], "sum": np.zeros(2)}

    def step(rows, carried):
        x, (total, largest) = carried["x"], carried["sum"]
        following = rows["A"].dot(x) + rows["dt"] * np.sin(x)
        rows.write_ahead("x", following)
        sums = [total + rows["dt"] * x.dot(x), larger(magnitude(x[0]), largest)]
        return {"x": following, "sum": np.array(sums, dtype=object)}

    def end(rows, carried):
        total, largest = carried["sum"]
        rows.write("sum", np.array([total + rows["x"].dot(rows["x"]), largest], dtype=object))

    return Recursion("ascending", step, start, end), layout


def _descending():
    """P_k = AᵀP_{k+1}A + q qᵀ, a symmetric matrix; the vector of the next node enters as well."""
    layout = {
        "A": Field((3, 3)), "q": Field((3,)), "P": Field((3, 3)), "trace": Field((), True),
        "weight": Field((2,), True), "v": Field((3,)), "pulled": Field((3,)),
    }  # fmt: skip

    def start(rows):
        return {"P": Symmetric(np.multiply.outer(rows["q"], rows["q"])), "trace": 0.0}

    def step(rows, carried):
        P, A, q = carried["P"], rows["A"], rows["q"]
        rows.write_ahead("P", P)
        rows.write("pulled", A.T.dot(rows.ahead("v")) * rows["weight"][1] - rows.ahead("q"))
        inner = A.T.dot(P).dot(A) + rows["weight"][0] * np.multiply.outer(q, q)
        return {"P": Symmetric(inner), "trace": carried["trace"] + np.sum(np.diagonal(P))}

    def end(rows, carried):
        rows.write("P", carried["P"])
        rows.write("trace", carried["trace"])

    return Recursion("descending", step, start, end, descending=True), layout


def _choosing():
    """Comparisons, parts and limits of signed numbers; no end."""
    layout = {"a": Field((4,)), "b": Field((4,)), "chosen": Field((5, 4)), "count": Field(())}

    def step(rows, carried):
        a, b = rows["a"], rows["b"]
        on = choose(a - b, 1.0 + 0.0 * a, 0.0 * a)
        parts = [
            choose(a, a * b, b), positive_part(a), larger(a, b), magnitude(a) * on,
            traced_erfc(a),
        ]  # fmt: skip
        rows.write("chosen", np.concatenate(parts))
        rows.write("count", carried["count"])
        return {"count": carried["count"] + np.sum(on)}

    return Recursion("choosing", step, lambda rows: {"count": 0.0}), layout


RECURSIONS = {"ascending": _ascending, "descending": _descending, "choosing": _choosing}


@pytest.mark.parametrize("K", [1, 2, 7])
@pytest.mark.parametrize("name", RECURSIONS)
def test_machine_code_computes_what_numpy_does(name, K):
    recursion, layout = RECURSIONS[name]()
    for seed in range(3):
        arrays = _arrays(layout, K, seed)
        native, plain = _both(recursion, layout, arrays, K)
        _agree(native, plain)
        assert any((native[field] != arrays[field]).any() for field in layout)


@pytest.mark.parametrize("run", ["machine code", "numpy"])
def test_an_ascending_recursion_is_the_sum_it_stands_for(run):
    recursion, layout = _ascending()
    K, arrays = 6, _arrays(layout, 6)
    x, known = [arrays["x"][0]], arrays["A"].reshape(-1, 3, 3)
    for k in range(K):
        x.append(known[k] @ x[k] + arrays["dt"][k] * np.sin(x[k]))
    total = sum(arrays["dt"][k, 0] * x[k] @ x[k] for k in range(K)) + x[K] @ x[K]
    largest = max(abs(x[k][0]) for k in range(K))
    first = 2.0 * x[0]
    got = dict(zip(("machine code", "numpy"), _both(recursion, layout, arrays, K), strict=True))
    np.testing.assert_allclose(got[run]["x"], x, rtol=1e-12)
    np.testing.assert_allclose(got[run]["sum"][0], [total, largest], rtol=1e-12)
    np.testing.assert_allclose(got[run]["first"][0], first, rtol=1e-12)


@pytest.mark.parametrize("run", ["machine code", "numpy"])
def test_a_descending_recursion_is_the_sum_it_stands_for(run):
    recursion, layout = _descending()
    K, arrays = 5, _arrays(layout, 5)
    A, q, v = arrays["A"].reshape(-1, 3, 3), arrays["q"], arrays["v"]
    w = arrays["weight"][0]
    P = [np.outer(q[K], q[K])]
    for k in range(K - 1, -1, -1):
        P.insert(0, A[k].T @ P[0] @ A[k] + w[0] * np.outer(q[k], q[k]))
    got = dict(zip(("machine code", "numpy"), _both(recursion, layout, arrays, K), strict=True))
    np.testing.assert_allclose(got[run]["P"].reshape(-1, 3, 3), P, atol=1e-12)
    assert got[run]["trace"][0, 0] == pytest.approx(sum(np.trace(M) for M in P[1:]), rel=1e-12)
    pulled = [w[1] * A[k].T @ v[k + 1] - q[k + 1] for k in range(K)]
    np.testing.assert_allclose(got[run]["pulled"][:K], pulled, atol=1e-13)
    np.testing.assert_array_equal(got[run]["pulled"][K], arrays["pulled"][K])


def test_nothing_is_written_but_what_is_meant():
    recursion, layout = _choosing()
    arrays = _arrays(layout, 4)
    native, plain = _both(recursion, layout, arrays, 4)
    for got in (native, plain):
        np.testing.assert_array_equal(got["chosen"][4], arrays["chosen"][4])
        for name in ("a", "b"):
            np.testing.assert_array_equal(got[name], arrays[name])


def test_several_recursions_of_one_module_share_arrays():
    (up, layout), (down, other) = _ascending(), _descending()
    layout = {**layout, **other}
    arrays = _arrays(layout, 4)
    native, plain = ({k: v.copy() for k, v in arrays.items()} for _ in range(2))
    code = _code([up, down], layout)
    for recursion in (up, down):
        _run(code, recursion.name, layout, native, 4)
        in_numpy(recursion, layout, plain, 4)
    _agree(native, plain)


def test_an_array_of_one_row_passes_values_from_node_to_node():
    layout = {"a": Field(()), "total": Field((), True)}

    def step(rows, carried):
        rows.write("total", rows["total"] + rows["a"])
        return {}

    arrays = _arrays(layout, 5)
    for got in _both(Recursion("summing", step, lambda rows: {}), layout, arrays, 5):
        wanted = arrays["total"][0, 0] + arrays["a"][:5].sum()
        assert got["total"][0, 0] == pytest.approx(wanted)


def test_what_is_read_after_it_was_written_is_the_same_either_way():
    layout = {"a": Field((2,)), "b": Field((2,))}

    def step(rows, carried):
        rows.write("a", 2.0 * rows["a"])
        rows.write("b", rows["a"])
        return {}

    _agree(*_both(Recursion("rereading", step, lambda rows: {}), layout, _arrays(layout, 3), 3))


def test_known_entries_are_constants_and_rows_of_others_are_read():
    layout = {"A": Field((2, 2)), "y": Field((2,))}
    graph = Graph()
    known = graph.inputs("A", (2, 2))
    known[0, 1], known[1, 1] = graph.constant(0.0), graph.constant(1.0)

    def step(rows, carried):
        rows.write("y", rows["A"].dot([3.0, 5.0]))
        return {}

    recursion, arrays = Recursion("known", step, lambda rows: {}), _arrays(layout, 3)
    native, plain = _both(recursion, layout, arrays, 3, {"A": known}, graph)
    A = arrays["A"][:3]
    np.testing.assert_allclose(plain["y"][:3], 3.0 * A[:, ::2] + 5.0 * A[:, 1::2])
    wanted = np.stack([3.0 * A[:, 0], 3.0 * A[:, 2] + 5.0], axis=1)
    np.testing.assert_allclose(native["y"][:3], wanted)


def test_rows_of_another_width_are_refused():
    layout = {"a": Field((3,))}
    recursion = Recursion("wide", lambda r, c: r.write("a", np.zeros(2)) or {}, lambda r: {})
    with pytest.raises(ValueError, match="a has rows of 3, not 2"):
        _code([recursion], layout)
    with pytest.raises(ValueError, match="3"):
        in_numpy(recursion, layout, _arrays(layout, 1), 1)


@pytest.mark.parametrize("kind", ["numbers", "symbols"])
def test_rows_that_were_read_can_be_changed_without_changing_the_arrays(kind):
    layout = {"a": Field((2, 2))}
    arrays = _arrays(layout, 1)
    rows = NumberRows(layout, arrays) if kind == "numbers" else SymbolRows(Graph(), layout, {})
    before = rows["a"].copy()
    changed = rows["a"]
    changed[:] = 0.0 * changed
    assert all(a is b or a == b for a, b in zip(rows["a"].flat, before.flat, strict=True))


def test_carried_values_come_back_as_they_were():
    graph = Graph()
    M = np.array([[1.0, 2.0], [2.0, 5.0]])
    carried = {"scalar": 3.0, "vector": graph.inputs("v", (3,)), "matrix": Symmetric(M)}
    flat, unpack = pack(carried)
    assert len(flat) == 1 + 3 + 3
    back = unpack(flat)
    assert back["scalar"] == 3.0
    assert all(a is b for a, b in zip(back["vector"], carried["vector"], strict=True))
    np.testing.assert_array_equal(back["matrix"].astype(float), M)


# ------------------------------------------------------------------------------- operations

SPECIAL = np.array(
    [0.0, -0.0, 5e-324, 1e-310, 1e-160, 0.3, -0.3, 1.0, -1.0, 7.0, -7.0, 710.0, -746.0, 1e160,
     -1e160, 1.7e308, np.inf, -np.inf, np.nan]
)  # fmt: skip
#: What an operation is in NumPy, where its name does not say.
IN_NUMPY = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide,
    "neg": np.negative, "erfc": erfc,
    "where": lambda c, a, b: np.where(c > 0.0, a, b),
    "greater": lambda a, b: 1.0 * (a > b), "greater_equal": lambda a, b: 1.0 * (a >= b),
    "equal": lambda a, b: 1.0 * (a == b),
}  # fmt: skip


@functools.cache
def _operations():
    """Machine code of every operation on the entries of x, by name."""
    names, graph = list(derivatives.OPERATIONS), Graph()
    layout = {"x": Field((3,)), **{name: Field(()) for name in names}}

    def step(rows, carried):
        x = rows["x"]
        for name in names:
            operands = tuple(x[: derivatives.OPERATIONS[name].arity])
            rows.write(name, graph.make(name, operands))
        return {}

    return layout, _code([Recursion("all", step, lambda rows: {})], layout, graph=graph)


@pytest.mark.parametrize("name", derivatives.OPERATIONS)
def test_operations_have_numpys_values_at_extreme_points(name):
    layout, code = _operations()
    arity = derivatives.OPERATIONS[name].arity
    grids = np.meshgrid(*[SPECIAL] * arity, indexing="ij")
    x = [grid.ravel() for grid in grids]
    K = len(x[0])
    arrays = {field: np.zeros((K + 1, f.width)) for field, f in layout.items()}
    for i, column in enumerate(x):
        arrays["x"][:K, i] = column
    _run(code, "all", layout, arrays, K)
    with np.errstate(all="ignore"):
        known = (IN_NUMPY.get(name) or getattr(np, name))(*x)
    got = arrays[name][:K, 0]
    np.testing.assert_allclose(got, known, rtol=4e-15, atol=1e-323, equal_nan=True)
    if name not in ("maximum", "minimum"):  # either zero is the larger one
        zero = known == 0.0
        np.testing.assert_array_equal(np.signbit(got[zero]), np.signbit(known[zero]))


def _grown(rng, leaves, depth):
    """A random expression of the leaves, numbers or symbols alike."""
    if depth == 0 or rng.random() < 0.1:
        return leaves[rng.integers(len(leaves))]
    a, b = (_grown(rng, leaves, depth - 1) for _ in range(2))
    kinds = [
        lambda: a + b, lambda: a - 0.7 * b, lambda: a * b, lambda: a / (2.0 + b * b),
        lambda: np.sin(a), lambda: np.exp(-a * a), lambda: np.sqrt(1.0 + a * a),
        lambda: np.tanh(a), lambda: np.add(0.0, choose(a - b, a, b)),
        lambda: np.add(0.0, larger(a, b)),
        lambda: magnitude(a), lambda: np.arctan2(a, 1.5 + b * b),
    ]  # fmt: skip
    return kinds[rng.integers(len(kinds))]()


def test_random_expressions_have_the_values_of_plain_numpy():
    count = 60
    layout = {"x": Field((3,)), "y": Field((count,))}

    def step(rows, carried):
        x = rows["x"]
        leaves = [*x, 0.3 + 0.0 * x[0], -1.0 + 0.0 * x[0]]
        rows.write("y", [_grown(np.random.default_rng(i), leaves, 6) for i in range(count)])
        return {}

    recursion, arrays = Recursion("random", step, lambda rows: {}), _arrays(layout, 9)
    native, plain = _both(recursion, layout, arrays, 9)
    np.testing.assert_allclose(native["y"], plain["y"], rtol=1e-11, atol=1e-11)
    assert len(np.unique(plain["y"][0])) > count // 2


def test_constants_are_kept_to_the_last_bit():
    values = [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -np.pi, np.inf, -np.inf, np.nan]
    layout = {"y": Field((len(values),))}

    def step(rows, carried):
        rows.write("y", np.array(values))
        return {}

    native, plain = _both(Recursion("c", step, lambda r: {}), layout, _arrays(layout, 1), 1)
    for got in (native, plain):
        np.testing.assert_array_equal(got["y"][0], values)


def test_what_is_not_a_number_is_carried_on_and_never_chosen():
    layout = {"a": Field((2,)), "b": Field((2,)), "y": Field((4, 2)), "last": Field((), True)}

    def step(rows, carried):
        a, b = rows["a"], rows["b"]
        rows.write("y", np.concatenate(
            [choose(a, 1.0 + 0.0 * b, b), larger(a, b), larger(b, a), positive_part(a)]
        ))  # fmt: skip
        return {"total": carried["total"] + a[0]}

    def end(rows, carried):
        rows.write("last", carried["total"])

    recursion = Recursion("nan", step, lambda rows: {"total": 0.0}, end)
    arrays = _arrays(layout, 2)
    arrays["a"][0] = np.nan
    for got in _both(recursion, layout, arrays, 2):
        y, b = got["y"].reshape(-1, 4, 2)[0], arrays["b"][0]
        np.testing.assert_array_equal(y[0], b)
        np.testing.assert_array_equal(y[1], b)
        assert np.isnan(y[2:]).all()
        assert np.isnan(got["last"]).all()


# ------------------------------------------------------------------------------------- on disk


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache folder of this test's own, in a process that has said nothing yet."""
    place = tmp_path / "cache"
    monkeypatch.setenv("SLIPCAR_CACHE_DIR", str(place))
    monkeypatch.setattr(machine_code, "_told", set())
    machine_code.folder.cache_clear()
    yield place
    machine_code.folder.cache_clear()


def _doubling():
    layout = {"a": Field(()), "b": Field(())}

    def step(rows, carried):
        rows.write("b", 2.0 * rows["a"])
        return {}

    return layout, Recursion("doubling", step, lambda rows: {})


class Assembly:
    """Assembly of a recursion that doubles; counts how often it was asked for."""

    def __init__(self):
        self.layout, self.recursion = _doubling()
        self.asked = 0

    def __call__(self):
        self.asked += 1
        return emit.module([self.recursion], Graph(), self.layout, {})

    def code(self, key=b"double", **more):
        return machine_code.code(key, ["doubling"], self, **more)

    def works(self, code):
        arrays = _arrays(self.layout, 3)
        _run(code, "doubling", self.layout, arrays, 3)
        np.testing.assert_array_equal(arrays["b"][:3], 2.0 * arrays["a"][:3])


def test_code_is_compiled_once_and_then_read(cache):
    assembly = Assembly()
    for _ in range(3):
        assembly.works(assembly.code())
    assert assembly.asked == 1
    assert [path.suffix for path in cache.iterdir()] == [".o"]


def test_each_key_has_a_file_of_its_own(cache):
    assembly = Assembly()
    for key in (b"one", b"two", b"one"):
        assembly.works(assembly.code(key))
    assert assembly.asked == 2
    assert len(list(cache.iterdir())) == 2


def test_another_generator_or_processor_is_another_file(cache, monkeypatch):
    assembly = Assembly()
    assembly.code()
    monkeypatch.setattr(machine_code, "_surroundings", lambda: b"another")
    assembly.works(assembly.code())
    assert assembly.asked == 2
    assert len(list(cache.iterdir())) == 2


#: What may have become of a file.
DAMAGES = {
    "truncated": lambda data: data[: len(data) // 2],
    "cut to its hash": lambda data: data[:32],
    "cut within its hash": lambda data: data[:7],
    "a bit turned": lambda data: data[:200] + bytes([data[200] ^ 1]) + data[201:],
    "its hash turned": lambda data: bytes([data[0] ^ 1]) + data[1:],
    "longer": lambda data: data + b"\0",
    "text": lambda data: b"not a program\n" * 9,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_compiled_anew_and_said_once(cache, damage, capfd):
    assembly = Assembly()
    assembly.code()
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    for _ in range(2):
        file.write_bytes(DAMAGES[damage](whole))
        assembly.works(assembly.code())
        assert file.read_bytes() == whole
    assert assembly.asked == 3
    said = capfd.readouterr().err
    assert said.count(str(file)) == 1
    assert "compiled anew" in said


def test_an_empty_file_is_compiled_anew(cache):
    assembly = Assembly()
    assembly.code()
    (file,) = cache.iterdir()
    file.write_bytes(b"")
    assembly.works(assembly.code())
    assert assembly.asked == 2
    assert file.stat().st_size > 32


def _read_only(place, monkeypatch):
    place.mkdir()

    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(machine_code.tempfile, "mkstemp", refuse)  # chmod does not stop root


def _a_file(place, monkeypatch):
    place.write_text("in the way")


def _below_a_file(place, monkeypatch):
    place.write_text("in the way")
    monkeypatch.setenv("SLIPCAR_CACHE_DIR", str(place / "deeper"))


def _full(place, monkeypatch):
    place.mkdir()

    def refuse(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(machine_code.os, "replace", refuse)


@pytest.mark.parametrize("spoil", [_read_only, _a_file, _below_a_file, _full])
def test_a_folder_that_cannot_be_written_to_is_done_without(cache, monkeypatch, spoil):
    spoil(cache, monkeypatch)
    assembly = Assembly()
    for asked in (1, 2):
        assembly.works(assembly.code())
        assert assembly.asked == asked
    left = list(cache.iterdir()) if cache.is_dir() else []
    assert left == []


def test_of_many_files_the_newest_are_kept(cache, monkeypatch):
    monkeypatch.setattr(machine_code, "_KEPT", 3)
    names = [f"{i:02}.o" for i in range(6)]
    for age, name in zip(range(6, 0, -1), names, strict=True):
        machine_code._write(cache / name, b"object")
        os.utime(cache / name, times=(1e9 - age, 1e9 - age))
    machine_code._write(cache / "newest.o", b"object")
    assert sorted(path.name for path in cache.iterdir()) == [*names[-2:], "newest.o"]


def test_without_a_home_there_is_no_folder(cache, monkeypatch):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    for name in ("SLIPCAR_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    machine_code.folder.cache_clear()
    assert machine_code.folder() is None
    assembly = Assembly()
    assembly.works(assembly.code())


@pytest.mark.parametrize(
    ("environment", "where"),
    [
        ({"SLIPCAR_CACHE_DIR": "{0}/own", "XDG_CACHE_HOME": "{0}/xdg"}, "own"),
        ({"XDG_CACHE_HOME": "{0}/xdg"}, "xdg/slipcar"),
        ({"SLIPCAR_CACHE_DIR": "", "XDG_CACHE_HOME": "", "HOME": "{0}"}, ".cache/slipcar"),
    ],
)
def test_where_files_are_kept(cache, tmp_path, monkeypatch, environment, where):
    for name in ("SLIPCAR_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value.format(tmp_path))
    machine_code.folder.cache_clear()
    assert machine_code.folder() == tmp_path / where
    Assembly().code()
    assert len(list((tmp_path / where).glob("*.o"))) == 1


def test_a_plan_in_a_fresh_process_without_home_or_cache(tmp_path):
    code = """
import os, pathlib, sys
def homeless(): raise RuntimeError("no home")
pathlib.Path.home = homeless
from slipcar.envs import Scenario
from slipcar.planner import plan
print(plan(Scenario.named("open").replace(nodes=5), compiled=True).status.name)
"""
    bare = {
        k: v for k, v in os.environ.items()
        if k not in ("HOME", "XDG_CACHE_HOME", "SLIPCAR_CACHE_DIR")
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", code], env=bare, capture_output=True, text=True, cwd=tmp_path
    )
    assert done.stdout.split() == ["CONVERGED"], done.stderr
    assert list(tmp_path.iterdir()) == []


def test_several_threads_may_ask_for_the_same_code(cache):
    assembly, wrong = Assembly(), []

    def work():
        try:
            assembly.works(assembly.code())
        except BaseException as error:
            wrong.append(error)

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    assert [path.suffix for path in cache.iterdir()] == [".o"]


def test_a_long_compilation_is_announced_and_a_known_one_is_not(cache, capfd):
    assembly = Assembly()
    assembly.code(estimate="compiling, some 9 s (once) ...")
    assert capfd.readouterr().err == "slipcar: compiling, some 9 s (once) ...\n"
    assembly.code(estimate="compiling, some 9 s (once) ...")
    assert capfd.readouterr().err == ""
