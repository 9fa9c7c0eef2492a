"""The C source of the twin's drivers: types, kernels, the model's graph and the loop around it."""

from collections.abc import Collection, Mapping
from importlib import metadata, resources
from typing import Any, NamedTuple

from terrafusion.twin.effects.catalogue import built_in, of_drives
from terrafusion.twin.engine.emit import Emitter
from terrafusion.twin.engine.graph import (
    CALLS,
    INPUT,
    OperationGraph,
    Outputs,
    UnsupportedOperationError,
    read,
    with_reciprocals,
)
from terrafusion.twin.engine.linear import eliminated
from terrafusion.twin.model.dynamics import rhs
from terrafusion.twin.model.measurement import measurement
from terrafusion.twin.model.version import model_sha256
from terrafusion.twin.physics.layout import (
    INDEX,
    INPUTS,
    MOUNTING,
    OUTPUTS,
    SOIL_PARAMETERS,
    STATES,
    VEHICLE_PARAMETERS,
    WHEELS,
)

__all__ = [
    "LANES",
    "LANES_32",
    "SINGLE",
    "TANGENT",
    "UnsupportedOperationError",
    "Variant",
    "source",
    "wheel_of",
]

SINGLE, LANES, LANES_32, TANGENT = "single", "lanes", "lanes_32", "tangent"
"""One run, its wheels side by side in a vector; several runs side by side; twice as many by numbers of 32
bits; one run with its derivatives."""

_ARGUMENTS = {
    "once": "const tf_real *vehicle, const tf_real *effects, const tf_real *soil, tf_real *held",
    "each": "const tf_real *x, const tf_real *u, const tf_real *vehicle, const tf_real *effects, "
    "const tf_real *soil, const tf_real *held, tf_real *local, tf_real *dx",
    "once_wide": "const tf_real *vehicle, const tf_real *effects, const tf_real *soil, const tf_real *held, "
    "const tf_wide *vehicle_wide, const tf_wide *effects_wide, const tf_wide *soil_wide, tf_wide *held_wide",
    "each_wide": "const tf_real *x, const tf_real *u, const tf_real *vehicle, const tf_real *effects, "
    "const tf_real *soil, const tf_real *held, const tf_real *local, const tf_wide *x_wide, "
    "const tf_wide *vehicle_wide, const tf_wide *effects_wide, const tf_wide *soil_wide, "
    "const tf_wide *held_wide, tf_wide *dx_wide",
}
_READER_ARGUMENTS = {
    "once": "const tf_real *vehicle, const tf_real *effects, const tf_real *soil, const tf_real *mounting, "
    "tf_real *held",
    "each": "const tf_real *x, const tf_real *u, const tf_real *vehicle, const tf_real *effects, "
    "const tf_real *soil, const tf_real *mounting, const tf_real *held, tf_real *local, tf_real *y",
}
_WIDE = ("x_wide", "vehicle_wide", "soil_wide", "effects_wide")


class Variant(NamedTuple):
    """Which driver: its kind, the optional effects in the graph, whether the soil is taken once a run.

    `active` names the parameters (argument, element) that change along some direction of a `TANGENT`: what
    the others would do is left out.
    """

    kind: str
    effects: tuple[str, ...]
    fixed_ground: bool
    active: frozenset[tuple[str, int]] = frozenset()


def follows_from(kind: object, effects: Collection[str]) -> str | None:
    """What the source of a graph with these effects follows from; None with effects of the user's own, whose
    names do not tell their laws."""
    known = {
        form.parameter_key(p) for form in built_in().values() for p in form.parameters
    } | of_drives().keys()
    if not known.issuperset(effects):
        return None
    return repr((model_sha256(), metadata.version("casadi"), kind, sorted(effects)))


def source(variant: Variant) -> str:
    """C source of a driver."""
    kind, effects, fixed_ground, active = variant
    function = rhs(effects) if kind != TANGENT else _with_tangent(rhs(effects))
    graph, outputs = with_reciprocals(*read(function, _element), {"x", "u"}, "dx")
    late = {"x", "u", "x_wide"} | (set() if fixed_ground else {"soil", "soil_wide"})
    if kind == TANGENT:
        graph, outputs = eliminated(
            graph, outputs, _WIDE, late, lambda name, i: not _changes(active, name, i)
        )
    wide = _WIDE if kind == TANGENT else ()
    lanes = kind in (LANES, LANES_32)
    emitter = Emitter(graph, outputs, late, wide, wheel_of, in_vectors=not lanes, short=kind == LANES_32)
    loops = [_text("driver.c"), _text("tangent.c")] if kind == TANGENT else [_text("driver.c")]
    if kind == TANGENT:
        loops.insert(0, _read_states(graph, outputs))
    return "\n".join([_sizes(effects), _prelude(kind), emitter.source(), *loops])


def reader_source(effects: tuple[str, ...], fixed_ground: bool) -> str:
    """C source of the sensors' readings, several samples side by side (see reader.c)."""
    late = {"x", "u"} if fixed_ground else {"x", "u", "soil"}
    graph, outputs = with_reciprocals(*read(measurement(effects), _element), late, "y")
    emitter = Emitter(graph, outputs, late, (), wheel_of, in_vectors=False)
    sizes = (
        f"{_sizes(effects, _READER_ARGUMENTS)}#define TF_NM {len(MOUNTING)}\n#define TF_NY {len(OUTPUTS)}\n"
    )
    return "\n".join([sizes, _prelude(LANES), emitter.source(), _text("reader.c")])


def _with_tangent(f: Any) -> Any:
    """The right-hand side with its derivative `dx_wide` along a direction, named by `_WIDE`."""
    import casadi as ca

    plain = {name: ca.SX.sym(name, f.size1_in(name)) for name in f.name_in()}
    seeds = {name: ca.SX.sym(name, f.size1_in(name.removesuffix("_wide"))) for name in _WIDE}
    dx = f(*plain.values())
    by = ca.vertcat(*(plain[name.removesuffix("_wide")] for name in _WIDE))
    tangent = ca.jtimes(dx, by, ca.vertcat(*seeds.values()))
    arguments = {**plain, **seeds}
    return ca.Function("tf_tangent", [*arguments.values()], [dx, tangent], [*arguments], ["dx", "dx_wide"],
                       {"cse": True})  # fmt: skip


def _read_states(graph: OperationGraph, outputs: Outputs) -> str:
    """Defines the states whose tangents others depend on, by the graph or by their place on the ground."""
    inputs = (graph.values[n] for n in graph.reached(outputs["dx_wide"]) if graph.ops[n] == INPUT)
    read = sorted({i for name, i in inputs if name == "x_wide"} | {INDEX["travel"]})
    return f"#define TF_READS {len(read)}\n#define TF_READ_STATES {{{', '.join(map(str, read))}}}"


def _changes(active: frozenset[tuple[str, int]], argument: str, element: int) -> bool:
    """Whether an element of an argument of `_WIDE` may differ from zero."""
    name = argument.removesuffix("_wide")
    return name == "x" or (name, element // len(WHEELS) if name == "soil" else element) in active


def wheel_of(argument: str, element: int) -> tuple[int, int] | None:
    """(wheel, its own element) of an argument of the C functions, None where no wheel owns it."""
    if argument.startswith("soil"):
        return element % len(WHEELS), element // len(WHEELS)
    if argument.startswith("x"):
        name = STATES[element]
        for k, wheel in enumerate(WHEELS):
            if name.endswith(f"_{wheel}"):
                return k, element - k
    return None


def _element(argument: str, i: int) -> int:
    """The C code holds each soil parameter of the four wheels side by side."""
    if not argument.startswith("soil"):
        return i
    wheel, parameter = divmod(i, len(SOIL_PARAMETERS))
    return parameter * len(WHEELS) + wheel


def _sizes(effects: tuple[str, ...], arguments: Mapping[str, str] = _ARGUMENTS) -> str:
    sizes = {"NX": len(STATES), "NU": len(INPUTS), "NV": len(VEHICLE_PARAMETERS), "NP": len(SOIL_PARAMETERS)}
    sizes |= {"NE": len(effects), "WHEELS": len(WHEELS)}
    sizes |= {name.upper(): INDEX[name] for name in ("x", "y", "yaw", "travel")}
    sizes |= {name.upper(): VEHICLE_PARAMETERS.index(f"{name}_m") for name in ("wheelbase", "track")}
    # No output overlaps what it is made of.
    heads = {f"{s.upper()}_ARGUMENTS": text.replace("*", "*restrict ") for s, text in arguments.items()}
    return "".join(f"#define TF_{name} {value}\n" for name, value in {**sizes, **heads}.items())


def _prelude(kind: str) -> str:
    if kind == LANES:
        return _LANES_HEAD + _kernels("tf_real", "TF_RUNS", "real") + _text("root.h")
    if kind == LANES_32:
        return _LANES_32_HEAD + _kernels("tf_real", "TF_RUNS", "real", short=True)
    head = _SINGLE_HEAD + _kernels("tf_four", "TF_WHEELS", "four") + _FOURS + _scalar_calls()
    return head + _WIDE_TYPE if kind == TANGENT else head


def _kernels(vector: str, width: str, suffix: str, short: bool = False) -> str:
    number, integer, size, series, libm = (
        ("float", "int", 4, "series_32.h", "name##f")
        if short
        else ("double", "long long", 8, "series_64.h", "name")
    )
    names = {"VEC": vector, "INT": f"{vector}_int", "WIDTH": width, "FN(name)": f"tf_##name##_{suffix}"}
    names |= {"NUMBER": number, "LIBM(name)": libm}
    types = (
        f"typedef {number} {vector} __attribute__((vector_size({size} * {width}), may_alias));\n"
        f"typedef {integer} {vector}_int __attribute__((vector_size({size} * {width}), may_alias));\n"
    )
    defines = "".join(f"#define TF_{name} {value}\n" for name, value in names.items())
    undefines = "".join(f"#undef TF_{name.split('(')[0]}\n" for name in names)
    return f"{types}{defines}{_text(series)}{_text('kernels.h')}{undefines}"


_HEAD = """
#include <math.h>
#include <string.h>
"""
_LANES_HEAD = f"""{_HEAD}
#if defined(__AVX512F__)
#define TF_RUNS 8
#else
#define TF_RUNS 4
#endif
typedef double tf_number;
"""
_LANES_32_HEAD = f"""{_HEAD}
#define TF_32
#if defined(__AVX512F__)
#define TF_RUNS 16
#else
#define TF_RUNS 8
#endif
typedef float tf_number;
typedef double tf_double __attribute__((vector_size(8 * TF_RUNS)));
#define TF_AS_DOUBLE(a) __builtin_convertvector(a, tf_double)
#define TF_AS_NUMBER(a) __builtin_convertvector(a, tf_real)
"""
_SINGLE_HEAD = f"""{_HEAD}
#define TF_RUNS 1
typedef double tf_real, tf_number;
"""
_WIDE_TYPE = """
#define TF_DIRECTIONS 4
typedef double tf_wide __attribute__((vector_size(8 * TF_DIRECTIONS), may_alias));
static inline tf_wide tf_splat_wide(double a) {
  tf_wide r;
  for (int i = 0; i < TF_DIRECTIONS; ++i) r[i] = a;
  return r;
}
"""
_FOURS = """
static inline double tf_splat_real(double a) { return a; }
static inline tf_four tf_get(const double *p) {
  tf_four r;
  memcpy(&r, p, sizeof r);
  return r;
}
static inline void tf_put(double *p, tf_four a) { memcpy(p, &a, sizeof a); }
"""


def _scalar_calls() -> str:
    """Functions of one number, by the vector's kernels: the same bits as in a vector."""
    lines = []
    for name, count in CALLS.items():
        names = "ab"[:count]
        splats = ", ".join(f"tf_splat_four({a})" for a in names)
        arguments = ", ".join(f"double {a}" for a in names)
        value = "sqrt(a)" if name == "sqrt" else f"tf_{name}_four({splats})[0]"
        lines.append(f"static inline double tf_{name}_real({arguments}) {{ return {value}; }}")
    return "\n".join(lines)


def _text(name: str) -> str:
    return (resources.files("terrafusion.twin.engine") / name).read_text(encoding="utf-8")
