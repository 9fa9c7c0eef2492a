"""C functions from a graph: what is fixed in a run computed once, equal work of the wheels four at a time.

Every node belongs to a stage, by what it depends on: "late" arguments change at every evaluation, "wide" ones
hold several directions of differentiation in a vector. Each stage becomes one C function; what a later stage
needs of an earlier one is stored in that stage's array.

Types in the C code: `tf_real` a number (or a vector of runs), `tf_four` one number for each wheel, `tf_wide`
a vector of directions.
"""

import heapq
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

from terrafusion.twin.engine.graph import (
    BINARY,
    CONST,
    INPUT,
    WHEELS,
    Atom,
    LaneOf,
    OperationGraph,
    Outputs,
    UnsupportedOperationError,
    packs,
)

_LATENCY = {"sqrt": 21, "div": 13, "exp": 70, "log": 80, "sin": 60, "cos": 60}
_LATENCY_ELSE = 4
"""Cycles until a result is there, about, on a processor of today."""
LEAST_32, MOST_32 = 1.2e-38, 3.4e38
"""Between these lie the normal numbers of 32 bits."""


@dataclass(frozen=True)
class Stage:
    """One C function: its name, the array it stores for later stages, and which nodes belong to it."""

    name: str
    store: str
    late: bool
    wide: bool


ONCE = Stage("once", "held", late=False, wide=False)
EACH = Stage("each", "local", late=True, wide=False)
ONCE_WIDE = Stage("once_wide", "held_wide", late=False, wide=True)
EACH_WIDE = Stage("each_wide", "", late=True, wide=True)
STAGES = (ONCE, EACH, ONCE_WIDE, EACH_WIDE)


@dataclass(eq=False)
class Emitter:
    """Writes the stages of a graph.

    Attributes:
        graph, outputs: what is to be computed.
        late, wide: names of the arguments that change at every evaluation, that are vectors of directions.
        lane_of: how arguments belong to wheels.
        in_vectors: whether the four wheels' equal operations are one vector operation, or four that stand
            together (several runs already fill the vectors).
        short: whether numbers have 32 bits.
    """

    graph: OperationGraph
    outputs: Outputs
    late: Collection[str]
    wide: Collection[str]
    lane_of: LaneOf
    in_vectors: bool
    short: bool = False
    sizes: dict[str, int] = field(default_factory=dict)
    _roots: int = 0

    def source(self) -> str:
        """The C functions of the stages that hold anything, and the sizes of what they store."""
        self._assign_stages()
        atoms = packs(self.graph, self._needed, self._pack_key, self.lane_of)
        self._packed = set(atoms)
        self._home = {n: (atom, k) for atom in atoms for k, n in enumerate(atom)}
        self._place()
        if not self.in_vectors:
            self._take_apart()
        functions = [self._function(stage) for stage in STAGES if self.wide or not stage.wide]
        defines = [f"#define TF_KEPT_{k.upper()} {max(n, 1)}" for k, n in self.sizes.items()]
        return "\n".join([*defines, *functions])

    def _assign_stages(self) -> None:
        graph = self.graph
        late, wide = graph.depends(self.late), graph.depends(self.wide)
        stages = {(s.late, s.wide): s for s in STAGES}
        self._needed = graph.reached(n for nodes in self.outputs.values() for n in nodes)
        self._stage = {n: stages[late[n], wide[n]] for n in self._needed}

    def _pack_key(self, n: int) -> object:
        """Only what is of one stage meets in a pack; vectors of directions do not."""
        return n if self._stage[n].wide else self._stage[n].name

    # Placing: what each stage computes, in which order, and what it stores for later ones

    def _atom(self, n: int) -> Atom:
        return self._home[n][0] if n in self._home else (n,)

    def _is_leaf(self, n: int) -> bool:
        return self.graph.ops[n] in (INPUT, CONST)

    def _place(self) -> None:
        self._slot: dict[Atom, int] = {}
        self.sizes = {s.store: 0 for s in STAGES if s.store}
        wanted: dict[Stage, list[Atom]] = {s: [] for s in STAGES}
        for name, nodes in self.outputs.items():
            wanted[_writer(name)] += [self._atom(n) for n in nodes if not self._is_leaf(n)]
        self._order: dict[Stage, list[Atom]] = {}
        for stage in reversed(STAGES):
            self._order[stage], borrowed = self._ordered(stage, wanted[stage])
            for atom in borrowed:
                if atom not in self._slot:
                    store = self._stage[atom[0]].store
                    self._slot[atom] = self.sizes[store]
                    self.sizes[store] += len(atom)
                    wanted[self._stage[atom[0]]].append(atom)

    def _take_apart(self) -> None:
        """One statement for each wheel. Where they stand together, the processor does them side by side."""
        for stage, atoms in self._order.items():
            self._order[stage] = [(n,) for atom in atoms for n in atom]
        self._slot = {(n,): first + k for atom, first in self._slot.items() for k, n in enumerate(atom)}
        self._home, self._packed = {}, set()

    def _ordered(self, stage: Stage, roots: Iterable[Atom]) -> tuple[list[Atom], list[Atom]]:
        """Atoms of a stage, operands first, and those of earlier stages that it takes."""
        order: dict[Atom, None] = {}
        borrowed: dict[Atom, None] = {}
        stack: list[tuple[Atom, bool]] = [(a, False) for a in reversed(list(roots))]
        while stack:
            atom, ready = stack.pop()
            if ready:
                order[atom] = None
            elif atom in order or atom in borrowed:
                continue
            elif self._stage[atom[0]] != stage:
                borrowed[atom] = None
            else:
                stack.append((atom, True))
                args = [a for n in atom for a in self.graph.args[n] if not self._is_leaf(a)]
                stack.extend((self._atom(a), False) for a in reversed(args))
        return self._longest_first(list(order)), list(borrowed)

    def _longest_first(self, order: list[Atom]) -> list[Atom]:
        """The atoms reordered: of those whose operands are there, the one with the longest path to a result.

        A processor looks only some hundred instructions ahead for work that does not wait for a result.
        """
        place = {atom: i for i, atom in enumerate(order)}
        operands = {
            atom: {self._atom(a) for n in atom for a in self.graph.args[n]} & place.keys() for atom in order
        }
        users: dict[Atom, list[Atom]] = {atom: [] for atom in order}
        for atom in order:
            for a in operands[atom]:
                users[a].append(atom)
        path_cycles: dict[Atom, int] = {}
        for atom in reversed(order):
            cycles = _LATENCY.get(self.graph.ops[atom[0]], _LATENCY_ELSE)
            path_cycles[atom] = cycles + max((path_cycles[user] for user in users[atom]), default=0)
        waiting = {atom: len(operands[atom]) for atom in order}
        ready = [(-path_cycles[atom], place[atom], atom) for atom in order if not waiting[atom]]
        heapq.heapify(ready)
        out = []
        while ready:
            atom = heapq.heappop(ready)[2]
            out.append(atom)
            for user in users[atom]:
                waiting[user] -= 1
                if not waiting[user]:
                    heapq.heappush(ready, (-path_cycles[user], place[user], user))
        return out

    # Writing

    def _function(self, stage: Stage) -> str:
        lines = [self._statement(stage, atom) for atom in self._order[stage]]
        for atom in self._order[stage]:
            if atom in self._slot:
                place = f"{stage.store} + {self._slot[atom]}"
                lines.append(
                    f"tf_put({place}, {_name(atom)});" if len(atom) > 1 else f"*({place}) = {_name(atom)};"
                )
        for name, nodes in self.outputs.items():
            if stage == _writer(name):
                lines += [f"{name}[{i}] = {self._output(stage, n)};" for i, n in enumerate(nodes)]
        return (
            f"static void tf_{stage.name}(TF_{stage.name.upper()}_ARGUMENTS) {{\n  "
            + "\n  ".join(lines)
            + "\n}\n"
        )

    def _statement(self, stage: Stage, atom: Atom) -> str:
        graph, first = self.graph, atom[0]
        op = graph.ops[first]
        suffix, kind = (
            ("four", "tf_four")
            if len(atom) > 1
            else ("wide", "tf_wide")
            if stage.wide
            else ("real", "tf_real")
        )
        args = [self._operand(stage, t) for t in zip(*(graph.args[n] for n in atom), strict=True)]
        if op in BINARY:
            value = f"{args[0]} {BINARY[op]} {args[1]}"
        elif op == "neg":
            value = f"-{args[0]}"
        else:
            self._roots += op == "sqrt"
            in_lanes = not (self.in_vectors or self.short)
            by_product = op == "sqrt" and in_lanes and self._roots % 2  # see root.h
            value = f"tf_{'root' if by_product else op}_{suffix}({', '.join(args)})"
        return f"const {kind} {_name(atom)} = {value};"

    def _operand(self, stage: Stage, t: Atom) -> str:
        """An operand: of one node, or of the four nodes of a pack."""
        if len(t) == 1 or len(set(t)) == 1:
            return self._scalar(stage, t[0])
        if t in self._packed:
            return (
                _name(t)
                if self._stage[t[0]] == stage
                else f"tf_get({self._stage[t[0]].store} + {self._slot[t]})"
            )
        values = [self.graph.values[n] for n in t]
        if all(self.graph.ops[n] == INPUT for n in t) and values == [
            (values[0][0], values[0][1] + k) for k in range(WHEELS)
        ]:
            return f"tf_get({values[0][0]} + {values[0][1]})"
        return f"(tf_four){{{', '.join(self._scalar(stage, n) for n in t)}}}"

    def _scalar(self, stage: Stage, n: int) -> str:
        """One node's value: the name of what was computed, a literal, an argument, or what was stored."""
        if self.graph.ops[n] == CONST:
            value = self._literal(self.graph.values[n])
            return f"({value})" if value.startswith("-") else value
        if self.graph.ops[n] == INPUT:
            name, i = self.graph.values[n]
            return f"{name}[{i}]"
        atom, k = self._home.get(n, ((n,), 0))
        if self._stage[n] != stage:
            return f"{self._stage[n].store}[{self._slot[atom] + k}]"
        return f"{_name(atom)}[{k}]" if len(atom) > 1 else _name(atom)

    def _literal(self, value: float) -> str:
        if not self.short:
            return repr(value)
        if value and not LEAST_32 < abs(value) < MOST_32:
            raise UnsupportedOperationError(f"{value!r} is no normal number of 32 bits")
        return f"{value!r}f"

    def _output(self, stage: Stage, n: int) -> str:
        text = self._scalar(stage, n)
        return f"tf_splat_{'wide' if stage.wide else 'real'}({text})" if self.graph.ops[n] == CONST else text


def _name(atom: Atom) -> str:
    return f"w{atom[0]}" if len(atom) > 1 else f"s{atom[0]}"


def _writer(output: str) -> Stage:
    """The stage that writes an output."""
    return EACH_WIDE if output.endswith("_wide") else EACH
