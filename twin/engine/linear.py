"""Derivatives with fewer operations: vertices of the linear graph eliminated where that saves edges.

Along a direction every tangent is a linear combination of earlier ones; each term is a multiplication and an
addition of vectors. The coefficients are numbers, the same for all directions, so a product of coefficients
is cheap. Eliminating a vertex joins its predecessors to its successors (Griewank and Walther 2008, Evaluating
Derivatives, ch. 9, vertex elimination with the lowest Markowitz degree).
"""

from collections import defaultdict
from collections.abc import Callable, Collection

from terrafusion.twin.engine.graph import CONST, INPUT, OperationGraph, Outputs

_Edges = dict[int, dict[int, int]]
"""vertex -> {neighbour: node of the coefficient}"""


def eliminated(
    graph: OperationGraph,
    outputs: Outputs,
    wide: Collection[str],
    late: Collection[str],
    is_zero: Callable[[str, int], bool],
) -> tuple[OperationGraph, Outputs]:
    """The graph with as few late terms in the tangents as greedy elimination finds.

    Args:
        graph, outputs: linear in the `wide` arguments; extended in place by new coefficients.
        wide: names of the arguments that are tangents.
        late: names of the arguments that change at every evaluation; tangents that do not depend on them are
            computed once and stay.
        is_zero: which elements of the wide arguments are zero along every direction.
    """
    is_late = graph.depends(late)
    is_wide = graph.depends_on_inputs(lambda name, i: name in wide and not is_zero(name, i))
    ends = {n for nodes in outputs.values() for n in nodes if is_wide[n]}
    vertices = [n for n in graph.reached(ends) if is_wide[n]]
    before: _Edges = {}
    after: _Edges = defaultdict(dict)
    for v in vertices:
        before[v] = _terms(graph, v, is_wide) if is_late[v] and graph.ops[v] != INPUT else {}
        for p, c in before[v].items():
            after[p][v] = c
    growth = {v: _growth(before, after, v) for v in vertices if before[v] and v not in ends}
    while growth:
        v = min(growth, key=lambda n: (growth[n], n))
        if growth.pop(v) >= 0:
            break
        for n in _eliminate(graph, before, after, v) & growth.keys():
            growth[n] = _growth(before, after, n)
    zeros = {n: graph.const(0.0) for n, some in enumerate(graph.depends(wide)) if some and not is_wide[n]}
    return _rebuilt(graph, outputs, vertices, before, zeros)


def _terms(graph: OperationGraph, v: int, is_wide: list[bool]) -> dict[int, int]:
    """What a vertex is made of: {vertex: coefficient}."""
    op, args = graph.ops[v], graph.args[v]
    one, minus = graph.const(1.0), graph.const(-1.0)
    if op in ("add", "sub"):
        terms = {args[0]: one} if is_wide[args[0]] else {}
        if is_wide[args[1]]:
            terms[args[1]] = _sum(graph, terms.get(args[1]), one if op == "add" else minus)
        return terms
    if op == "neg":
        return {args[0]: minus}
    if op == "div" and not is_wide[args[1]]:
        return {args[0]: graph.node("div", one, args[1])}
    if op == "mul" and is_wide[args[0]] != is_wide[args[1]]:
        tangent, factor = args if is_wide[args[0]] else args[::-1]
        return {tangent: factor}
    raise ValueError(f"the tangent is not linear: '{op}'")


def _growth(before: _Edges, after: _Edges, v: int) -> int:
    """How many more terms there are without the vertex."""
    new = sum(p not in before[s] for p in before[v] for s in after[v])
    return new - len(before[v]) - len(after[v])


def _eliminate(graph: OperationGraph, before: _Edges, after: _Edges, v: int) -> set[int]:
    """Join the neighbours of a vertex; those whose `_growth` may have changed."""
    touched = {*before[v], *after[v]}
    for s, outer in after.pop(v).items():
        del before[s][v]
        for p, inner in before[v].items():
            total = _sum(graph, before[s].get(p), _product(graph, outer, inner))
            before[s][p] = after[p][s] = total
        touched.update(before[s])
    for p in before.pop(v):
        del after[p][v]
    return touched


def _rebuilt(
    graph: OperationGraph, outputs: Outputs, vertices: list[int], before: _Edges, moved: dict[int, int]
) -> tuple[OperationGraph, Outputs]:
    """The graph made of the terms that are left; `moved` holds where nodes went and is filled."""
    for v in vertices:
        terms = before.get(v)
        if terms is None:
            continue
        total = None if terms else v
        for p, c in sorted(terms.items()):
            total = _sum(graph, total, _product(graph, c, moved[p]))
        moved[v] = v if total is None else total
    return graph, {name: [moved.get(n, n) for n in nodes] for name, nodes in outputs.items()}


def _is(graph: OperationGraph, n: int, value: float) -> bool:
    return graph.ops[n] == CONST and graph.values[n] == value


def _product(graph: OperationGraph, a: int, b: int) -> int:
    for this, other in ((a, b), (b, a)):
        if _is(graph, this, 1.0):
            return other
        if _is(graph, this, -1.0):
            return graph.args[other][0] if graph.ops[other] == "neg" else graph.node("neg", other)
    return graph.node("mul", a, b)


def _sum(graph: OperationGraph, a: int | None, b: int) -> int:
    if a is None:
        return b
    if graph.ops[b] == "neg":
        return graph.node("sub", a, graph.args[b][0])
    return graph.node("add", a, b)
