"""A CasADi SX function as a plain graph of scalar operations, rewritten for speed.

Every node is an operation on earlier nodes, so the numbers of the nodes are a topological order. Operations
that are the same for the four wheels are found, so that one vector instruction does them.
"""

import functools
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable
from dataclasses import dataclass, field
from operator import add, mul, neg, sub, truediv
from typing import Any, NamedTuple

INPUT, CONST = "input", "const"
BINARY = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
CALLS = {
    "sqrt": 1, "exp": 1, "log": 1, "sin": 1, "cos": 1, "tan": 1, "asin": 1, "acos": 1, "atan": 1, "sinh": 1,
    "cosh": 1, "tanh": 1, "erf": 1, "floor": 1, "ceil": 1, "fabs": 1, "fmin": 2, "fmax": 2, "atan2": 2,
}  # fmt: skip
"""Operations that are functions in C, and their numbers of arguments."""


_FOLDED: dict[str, Callable[..., float]] = {"add": add, "sub": sub, "mul": mul, "div": truediv, "neg": neg}
WHEELS = 4
Atom = tuple[int, ...]
"""A value of the C code: one node, or the same operation for the four wheels."""
LaneOf = Callable[[str, int], "tuple[int, int] | None"]
"""(argument, element) -> (wheel, the wheel's own element), None where no wheel owns it."""


class UnsupportedOperationError(ValueError):
    """The graph holds an operation that is not written as C here."""


@dataclass(eq=False)
class OperationGraph:
    """Operations without repetition.

    Attributes:
        ops: name of each node's operation: a key of `BINARY` or `CALLS`, "neg", `INPUT` or `CONST`.
        args: numbers of the nodes it takes.
        values: (name of the argument, element) of an input, number of a constant, else None.
    """

    ops: list[str] = field(default_factory=list)
    args: list[tuple[int, ...]] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    _known: dict[tuple[Any, ...], int] = field(default_factory=dict)

    def node(self, op: str, *args: int, value: Any = None) -> int:
        """Number of the node, new or known; arithmetic of constants is done here."""
        if op in _FOLDED and all(self.ops[a] == CONST for a in args):
            return self.const(_FOLDED[op](*(self.values[a] for a in args)))
        key = (op, args, value)
        if key not in self._known:
            self._known[key] = len(self.ops)
            self.ops.append(op)
            self.args.append(args)
            self.values.append(value)
        return self._known[key]

    def const(self, value: float) -> int:
        """Number of a constant's node."""
        return self.node(CONST, value=float(value))

    def reached(self, roots: Iterable[int]) -> list[int]:
        """The roots and all they are made of, in topological order."""
        found: set[int] = set()
        stack = list(roots)
        while stack:
            n = stack.pop()
            if n not in found:
                found.add(n)
                stack.extend(self.args[n])
        return sorted(found)

    def depends(self, names: Collection[str]) -> list[bool]:
        """Whether each node depends on one of the named arguments."""
        return self.depends_on_inputs(lambda name, i: name in names)

    def depends_on_inputs(self, which: Callable[[str, int], bool]) -> list[bool]:
        """Whether each node depends on one of the elements (argument, i) for which `which` holds."""
        out: list[bool] = []
        for op, args, value in zip(self.ops, self.args, self.values, strict=True):
            out.append(which(*value) if op == INPUT else any(out[a] for a in args))
        return out


Outputs = dict[str, list[int]]
"""Nodes of each output by its name."""


def read(function: Any, element: Callable[[str, int], int]) -> tuple[OperationGraph, Outputs]:
    """The graph of a CasADi SX `Function` and the nodes of its outputs.

    `element(argument, i)` is where the C code holds the argument's i-th element.

    Raises:
        UnsupportedOperationError: an operation that cannot be written as C here.
    """
    graph = OperationGraph()
    outputs = {name: [graph.const(0.0)] * function.numel_out(i) for i, name in enumerate(function.name_out())}
    in_slot: dict[int, int] = {}
    names = _operations()
    for k in range(function.n_instructions()):
        op = names[function.instruction_id(k)]
        inputs, slots = function.instruction_input(k), function.instruction_output(k)
        if op == "OP_OUTPUT":
            name = function.name_out(slots[0])
            row, column = function.sparsity_out(slots[0]).get_triplet()
            height = function.size1_out(slots[0])
            outputs[name][row[slots[1]] + height * column[slots[1]]] = in_slot[inputs[0]]
        elif op == "OP_INPUT":
            name = function.name_in(inputs[0])
            in_slot[slots[0]] = graph.node(INPUT, value=(name, element(name, inputs[1])))
        elif op == "OP_CONST":
            in_slot[slots[0]] = graph.const(function.instruction_constant(k))
        else:
            in_slot[slots[0]] = _translated(graph, op, *(in_slot[i] for i in inputs))
    return graph, outputs


@functools.cache
def _operations() -> dict[int, str]:
    import casadi as ca

    return {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}


def _translated(graph: OperationGraph, op: str, *args: int) -> int:
    """Node of a CasADi operation."""
    name = op.removeprefix("OP_").lower()
    if name == "sq":
        return graph.node("mul", args[0], args[0])
    if name == "twice":
        return graph.node("add", args[0], args[0])
    if name == "inv":
        return graph.node("div", graph.const(1.0), args[0])
    if name == "assign":
        return args[0]
    if name in ("pow", "constpow"):  # of positive numbers only: z^a = exp(a log z)
        return graph.node("exp", graph.node("mul", args[1], graph.node("log", args[0])))
    if name in ("neg", *BINARY, *CALLS):
        return graph.node(name, *args)
    raise UnsupportedOperationError(f"the model uses {op}, which is not written as C")


def with_reciprocals(
    graph: OperationGraph, outputs: Outputs, late: Collection[str], main: str
) -> tuple[OperationGraph, Outputs]:
    """The graph with a / b as a (1 / b) where 1 / b serves several times.

    That is where b does not depend on the `late` arguments, or divides more than one number on the way to
    the `main` output: its value has the same bits whatever else is computed beside it.
    """
    is_late = graph.depends(late)
    divisions = Counter(graph.args[n][1] for n in graph.reached(outputs[main]) if graph.ops[n] == "div")

    def rule(new: OperationGraph, n: int, args: tuple[int, ...]) -> int:
        if graph.ops[n] == "div":
            by = graph.args[n][1]
            one = graph.ops[graph.args[n][0]] == CONST and graph.values[graph.args[n][0]] == 1.0
            if not one and (divisions[by] > 1 or not is_late[by]):
                return new.node("mul", args[0], new.node("div", new.const(1.0), args[1]))
        return new.node(graph.ops[n], *args, value=graph.values[n])

    return _rewritten(graph, outputs, rule)


def _rewritten(graph: OperationGraph, outputs: Outputs, rule: Any) -> tuple[OperationGraph, Outputs]:
    new = OperationGraph()
    moved: dict[int, int] = {}
    for n in graph.reached(n for nodes in outputs.values() for n in nodes):
        moved[n] = rule(new, n, tuple(moved[a] for a in graph.args[n]))
    return new, {name: [moved[n] for n in nodes] for name, nodes in outputs.items()}


class _Trait(NamedTuple):
    """Of a node: the wheel that owns it (None: shared), how often wheels have met on the way to it, its shape
    with wheels left out, and its height over the inputs."""

    wheel: int | None
    meetings: int
    shape: Hashable
    height: int


def packs(
    graph: OperationGraph, nodes: Iterable[int], key: Callable[[int], Hashable], lane_of: LaneOf
) -> list[Atom]:
    """Groups of four nodes, one for each wheel in their order, with the same operation.

    Any choice of groups gives right code; a good one gives fast code. Here nodes of single wheels that look
    alike are grouped, then what all wheels share but each in its own way, where a group takes it as operand.
    Only nodes of the same `key` meet in a group. No group depends on itself: within one, nodes have met other
    wheels' values equally often.

    Args:
        nodes: those that are needed, in topological order.
        key: what else must be equal in a group.
        lane_of: which arguments belong to which wheel.
    """
    traits = _traits(graph, nodes, lane_of)
    groups: dict[Hashable, list[list[int]]] = defaultdict(lambda: [[] for _ in range(WHEELS)])
    for n, trait in traits.items():
        if trait.wheel is not None and graph.args[n]:
            groups[trait.shape, key(n)][trait.wheel].append(n)
    found = [atom for wheels in groups.values() for atom in zip(*wheels, strict=False)]
    taken = {n for atom in found for n in atom}
    for atom in found:  # grows on the way
        for operands in zip(*(graph.args[n] for n in atom), strict=True):
            alike = {(graph.ops[n], traits[n].height, traits[n].meetings, key(n)) for n in operands}
            new = taken.isdisjoint(operands) and len(set(operands)) == WHEELS
            if len(alike) == 1 and new and graph.args[operands[0]]:
                found.append(operands)
                taken.update(operands)
    return found


def _traits(graph: OperationGraph, nodes: Iterable[int], lane_of: LaneOf) -> dict[int, _Trait]:
    traits: dict[int, _Trait] = {}
    numbers: dict[Hashable, int] = {}  # a short name for each shape
    for n in nodes:
        op, value, args = graph.ops[n], graph.values[n], [traits[a] for a in graph.args[n]]
        owner = lane_of(*value) if op == INPUT else None
        wheels = {owner[0]} if owner else {a.wheel for a in args} - {None}
        meetings = max((a.meetings for a in args), default=0) + (len(wheels) > 1)
        shape: Hashable = ("shared", meetings)
        if len(wheels) == 1:
            shape = (value[0], owner[1]) if owner else (op, *(a.shape for a in args))
            shape = numbers.setdefault(shape, len(numbers))
        height = 1 + max((a.height for a in args), default=0)
        traits[n] = _Trait(wheels.pop() if len(wheels) == 1 else None, meetings, shape, height)
    return traits
