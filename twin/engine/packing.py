"""Which operations of a graph are the same for the four wheels, so that one vector instruction does them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable
from typing import NamedTuple

from terrafusion.twin.engine.graph import INPUT, OperationGraph

WHEELS = 4
Atom = tuple[int, ...]
"""A value of the C code: one node, or the same operation for the four wheels."""
LaneOf = Callable[[str, int], "tuple[int, int] | None"]
"""(argument, element) -> (wheel, the wheel's own element), None where no wheel owns it."""


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
        graph: the operations.
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
