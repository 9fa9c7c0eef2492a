"""Spread and correlation time of slip between stretches of ground, from the nodes of a drive's smoother.

The smoother takes the ratios of nodes as independent about the wheel scale. Their expected squares give the
spread (expectation maximisation), and their expected products the correlation from one node to the next,
where they are known: a node counts by the share g of its variance that the fixes determine.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

PRIOR_NODES, PRIOR_PAIRS = 3.0, 30.0
"""Nodes that the assumed spread of slip counts for, and pairs of neighbours that the assumed correlation
counts for: a wheel that breaks loose once is no slip that comes and goes (assumed)."""
LEAST_SPREAD = 0.005
LEAST_NODE_SHARE = 0.5
"""Least correlation time over the time between nodes: within a node slip is not seen."""


@dataclass(frozen=True)
class SlipMoments:
    """Sums over the nodes of a drive in which the robot drove.

    Attributes:
        nodes: their number.
        squares: of the expected squares of the ratios about the wheel scale.
        products: of the expected products of neighbours.
        known: of the shares g g' of the products that fixes determine.
        apart_s: of the times between neighbours, by these shares.
    """

    nodes: int
    squares: float
    products: float
    known: float
    apart_s: float


def slip_process(
    moments: Sequence[SlipMoments], assumed_spread: float, assumed_time_s: float
) -> tuple[float, float]:
    """Spread and correlation time, s, of slip; the time is at most the one assumed."""
    nodes = PRIOR_NODES + sum(m.nodes for m in moments)
    spread = math.sqrt((PRIOR_NODES * assumed_spread**2 + sum(m.squares for m in moments)) / nodes)
    spread, known = max(spread, LEAST_SPREAD), sum(m.known for m in moments)
    if known <= 0.0:
        return spread, assumed_time_s
    apart_s = sum(m.apart_s for m in moments) / known
    assumed = math.exp(-apart_s / assumed_time_s)
    seen = sum(m.products for m in moments) / spread**2
    correlation = (PRIOR_PAIRS * assumed + seen) / (PRIOR_PAIRS + known)
    least = math.exp(-1.0 / LEAST_NODE_SHARE)
    return spread, -apart_s / math.log(min(max(correlation, least), assumed))
