"""The written C: functions against numpy's, what is packed together, bits against another compiler."""

from __future__ import annotations

import ctypes
import importlib.util
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from terrafusion.twin.engine import codegen, compiler, native
from terrafusion.twin.engine.codegen import LANES, LANES_32, SINGLE, Variant
from terrafusion.twin.engine.emit import Emitter
from terrafusion.twin.engine.graph import CONST, UnsupportedOperationError, packs, read
from terrafusion.twin.engine.integrate import compiled, integrate
from terrafusion.twin.engine.lanes import integrate_many
from terrafusion.twin.model.plant import Plant, RouteTable
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import STATES
from terrafusion.twin.scenario.commands import delayed_inputs

needs_compiler = pytest.mark.skipif(not compiled(), reason="no C compiler")
KERNELS = """
void call_{0}(long n, const double *x, double *y) {{
  for (long i = 0; i < n; i += TF_RUNS) {{
    tf_real a;
    for (int k = 0; k < TF_RUNS; ++k) ((tf_number *)&a)[k] = (tf_number)x[i + k];
    a = tf_{0}_real(a);
    for (int k = 0; k < TF_RUNS; ++k) y[i + k] = ((tf_number *)&a)[k];
  }}
}}
"""


def kernels(kind: str, names: tuple[str, ...]):
    """kernel(name, x) -> values of a vector kernel, x a multiple of 16 long."""
    source = codegen._prelude(kind) + "".join(KERNELS.format(name) for name in names)
    command = compiler.find_compiler()
    assert command is not None
    library = ctypes.CDLL(str(compiler.compiled(source, command)))

    def call(name: str, x: np.ndarray) -> np.ndarray:
        y = np.empty_like(x)
        getattr(library, f"call_{name}")(ctypes.c_long(len(x)), native.pointer(x), native.pointer(y))
        return y

    return call


@pytest.fixture(scope="module")
def kernel():
    return kernels(LANES, ("exp", "log", "sin", "cos", "tanh", "sqrt", "root"))


@pytest.fixture(scope="module")
def kernel_32():
    return kernels(LANES_32, ("exp", "log", "sin", "cos", "tanh", "sqrt"))


@needs_compiler
@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("exp", -700.0, 700.0), ("exp", -1.0, 1.0), ("log", 1e-300, 1e300), ("log", 0.9, 1.1),
     ("sin", -4.0, 4.0), ("cos", -4.0, 4.0), ("sin", -1e5, 1e5), ("cos", -1e5, 1e5),
     ("tanh", -1.0, 1.0), ("tanh", -30.0, 30.0)],
)  # fmt: skip
def test_functions_are_right_to_four_units_in_the_last_place(kernel, name, low, high) -> None:
    rng = np.random.default_rng(1)
    x = np.geomspace(low, high, 1 << 15) if low == 1e-300 else rng.uniform(low, high, 1 << 15)
    exact = getattr(np, name)(x.astype(np.longdouble))
    ulp = np.spacing(np.abs(exact.astype(float)))
    if name in ("sin", "cos"):  # near a zero the error is that of the argument
        ulp = np.maximum(ulp, 2.0**-60)
    assert float((np.abs(kernel(name, x) - exact) / ulp).max()) < 4.0


@needs_compiler
@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("exp", -80.0, 80.0), ("exp", -1.0, 1.0), ("log", 1e-37, 1e37), ("log", 0.9, 1.1),
     ("sin", -4.0, 4.0), ("cos", -4.0, 4.0), ("sin", -1e3, 1e3), ("cos", -1e3, 1e3),
     ("tanh", -1.0, 1.0), ("tanh", -30.0, 30.0), ("sqrt", 0.0, 1e4)],
)  # fmt: skip
def test_functions_of_32_bits_are_right_to_four_units_in_the_last_place(kernel_32, name, low, high) -> None:
    rng = np.random.default_rng(1)
    x = np.geomspace(low, high, 1 << 15) if low == 1e-37 else rng.uniform(low, high, 1 << 15)
    x = x.astype(np.float32).astype(float)
    exact = getattr(np, name)(x)
    ulp = np.spacing(np.abs(exact).astype(np.float32)).astype(float)
    if name in ("sin", "cos"):
        ulp = np.maximum(ulp, 2.0**-31)
    assert float((np.abs(kernel_32(name, x) - exact) / ulp).max()) < 4.0


@needs_compiler
def test_functions_of_32_bits_at_the_edges(kernel_32) -> None:
    edges = np.array([0.0, -1.0, np.nan, np.inf, -np.inf, 1.0, 100.0, -100.0] * 2)
    at = kernel_32("exp", edges)
    np.testing.assert_allclose(at[[0, 1, 5, 7]], [1.0, np.exp(-1.0), np.e, 0.0], rtol=1e-6, atol=1e-37)
    assert at[6] > 1e38
    np.testing.assert_array_equal(kernel_32("log", edges)[[0, 1, 2, 5]], [-np.inf, np.nan, np.nan, 0.0])
    np.testing.assert_array_equal(kernel_32("tanh", edges)[[0, 3, 4, 6, 7]], [0.0, 1.0, -1.0, 1.0, -1.0])
    for name in ("exp", "log", "sin", "cos", "tanh", "sqrt"):
        assert np.isnan(kernel_32(name, edges)[2])


def test_a_number_that_32_bits_do_not_hold_is_reported() -> None:
    graph, outputs = read(ca.Function("f", [x := ca.SX.sym("x")], [x + 1e-60], ["x"], ["dx"]), lambda n, i: i)
    for short in (False, True):
        emitter = Emitter(graph, outputs, {"x"}, (), lambda name, i: None, in_vectors=False, short=short)
        if not short:
            assert "1e-60;" in emitter.source()
            continue
        with pytest.raises(UnsupportedOperationError, match="1e-60"):
            emitter.source()


@needs_compiler
def test_functions_at_the_edges(kernel) -> None:
    edges = np.array([0.0, -1.0, np.nan, np.inf, -np.inf, 1.0, 800.0, -800.0])
    np.testing.assert_allclose(
        kernel("exp", edges)[[0, 1, 5, 7]], [1.0, np.exp(-1.0), np.e, 0.0], atol=1e-300
    )
    assert kernel("exp", edges)[6] > 1e307
    np.testing.assert_array_equal(kernel("log", edges)[[0, 1, 2, 5]], [-np.inf, np.nan, np.nan, 0.0])
    np.testing.assert_array_equal(kernel("tanh", edges)[[0, 3, 4, 6, 7]], [0.0, 1.0, -1.0, 1.0, -1.0])
    for name in ("exp", "log", "sin", "cos", "tanh", "sqrt", "root"):
        assert np.isnan(kernel(name, edges)[2])
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(kernel("root", edges), np.sqrt(edges))


@needs_compiler
def test_roots_by_multiplication_have_the_bits_of_roots(kernel) -> None:
    rng = np.random.default_rng(4)
    x = np.concatenate([rng.uniform(0.0, 4.0, 1 << 18), 10.0 ** rng.uniform(-300, 300, 1 << 18)])
    whole = np.arange(1.0, 1 + (1 << 18)) ** 2
    for values in (x, whole, np.nextafter(whole, 0.0), np.nextafter(whole, np.inf)):
        np.testing.assert_array_equal(kernel("root", values), np.sqrt(values))


def test_an_unknown_operation_is_reported() -> None:
    x = ca.SX.sym("x", 2)
    f = ca.Function("f", [x], [ca.if_else(x[0] > 0, x[1], 1.0)], ["x"], ["dx"])
    with pytest.raises(UnsupportedOperationError, match="OP_"):
        read(f, lambda name, i: i)


def test_equal_work_of_the_wheels_is_found_and_never_waits_for_itself() -> None:
    """Each wheel's a_k + b, then their sum s, then a_k s: two packs, none of the sums."""
    a, b = ca.SX.sym("a", 4), ca.SX.sym("b")
    first = [a[k] + b for k in range(4)]
    total = first[0] + first[1] + first[2] + first[3]
    f = ca.Function("f", [a, b], [ca.vertcat(*(a[k] * total for k in range(4)))], ["a", "b"], ["dx"])
    graph, outputs = read(f, lambda name, i: i)
    found = packs(
        graph, graph.reached(outputs["dx"]), lambda n: 0, lambda name, i: (i, 0) if name == "a" else None
    )
    assert {graph.ops[atom[0]] for atom in found} == {"add", "mul"}
    assert len(found) == 2
    assert tuple(outputs["dx"]) in found


def test_arithmetic_of_constants_is_done_beforehand() -> None:
    graph, _ = read(ca.Function("f", [x := ca.SX.sym("x")], [x], ["x"], ["dx"]), lambda name, i: i)
    n = graph.node("div", graph.const(1.0), graph.node("add", graph.const(1.5), graph.const(0.5)))
    assert (graph.ops[n], graph.values[n]) == (CONST, 0.5)


@needs_compiler
@pytest.mark.parametrize("flags", ["-O1", "-mno-avx512f"])
def test_bits_do_not_depend_on_the_compiler_or_the_width_of_its_vectors(monkeypatch, tmp_path, flags) -> None:
    """The same runs by ziglang, with other optimisation or without the widest vectors."""
    if importlib.util.find_spec("ziglang") is None:
        pytest.skip("the package ziglang is not installed")
    here = short_run()
    monkeypatch.setenv("TERRAFUSION_CACHE", str(tmp_path))
    monkeypatch.setattr(compiler, "find_compiler", lambda: (sys.executable, "-m", "ziglang", "cc"))
    monkeypatch.setattr(compiler, "FLAGS", (*compiler.FLAGS, flags))
    native.forget()
    try:
        there = short_run()
    finally:
        native.forget()
    assert list(Path(tmp_path).glob("*.so"))
    np.testing.assert_array_equal(here, there)


def short_run() -> np.ndarray:
    t = np.arange(201) * 0.01
    sides = np.stack([np.minimum(6.0 * t, 5.0), np.minimum(6.0 * t, 4.0)], axis=1)
    route = RouteTable("travel", np.zeros(1), soil_vector(load_soil("loose_sand"))[None])
    plant = Plant(vehicle_vector(load_vehicle("elevate"), slope_rad=0.05, aspect_rad=1.0), route)
    assert native.driver(Variant(SINGLE, (), True)) is not None
    alone = integrate(np.zeros(len(STATES)), delayed_inputs(sides, 0.01), 0.01, plant, backend="c")
    assert native.driver(Variant(LANES_32, (), True)) is not None
    in_32_bits = integrate_many(alone[:1], delayed_inputs(sides, 0.01), 0.01, [plant], short=True)[0]
    return np.concatenate([alone, in_32_bits])
