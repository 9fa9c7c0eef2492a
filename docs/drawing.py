"""A Mermaid flow chart as an SVG drawing, so that the site needs no program from outside.

It reads what `tests/architecture.py` writes: subgraphs, `id[label]` nodes, `a --> b` arrows without a cycle.
"""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence

WIDTH, ROW, HEIGHT, CHAR, GAP = 860.0, 58.0, 26.0, 7.4, 18.0
"""Of the drawing, from row to row, of a box, of a letter, between boxes; px."""
COLOURS = ("#4477aa", "#228833", "#aa5511", "#aa3377")
Arrow = tuple[str, str]


def parsed(text: str) -> tuple[dict[str, str], dict[str, str], list[Arrow]]:
    """Label and group of each node, and the arrows."""
    labels: dict[str, str] = {}
    groups: dict[str, str] = {}
    arrows: list[Arrow] = []
    group = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("subgraph"):
            group = line.split()[1]
        elif line == "end":
            group = ""
        elif node := re.fullmatch(r"(\w+)\[(.*)\]", line):
            labels[node[1]], groups[node[1]] = node[2], group
        elif arrow := re.fullmatch(r"(\w+) --> (\w+)", line):
            arrows.append((arrow[1], arrow[2]))
            for name in arrow.groups():
                labels.setdefault(name, name)
                groups.setdefault(name, name)
    return labels, groups, arrows


def rows_of(nodes: Sequence[str], arrows: Sequence[Arrow]) -> list[list[str]]:
    """Nodes in rows from the top: each above all that it points at, near what points at it."""
    below: Mapping[str, list[str]] = {node: [b for a, b in arrows if a == node] for node in nodes}
    depth: dict[str, int] = {}

    def depth_of(node: str) -> int:
        if node not in depth:
            depth[node] = 1 + max(map(depth_of, below[node]), default=-1)
        return depth[node]

    rows: list[list[str]] = [[] for _ in range(1 + max(map(depth_of, nodes), default=-1))]
    for node in nodes:
        rows[-1 - depth[node]].append(node)
    place: dict[str, float] = {}
    for row in rows:
        above = {node: [place[a] for a, b in arrows if b == node and a in place] for node in row}
        row.sort(key=lambda node: sum(above[node]) / len(above[node]) if above[node] else 0.5)
        place |= {node: (i + 1) / (len(row) + 1) for i, node in enumerate(row)}
    return rows


def svg(text: str) -> str:
    """The drawing; its text and arrows have the colour of the page's text."""
    labels, groups, arrows = parsed(text)
    colours = dict(zip(dict.fromkeys(groups.values()), COLOURS, strict=False))
    rows = rows_of(list(labels), arrows)
    at: dict[str, tuple[float, float]] = {}
    for i, row in enumerate(rows):
        for j, node in enumerate(row):
            at[node] = (WIDTH * (j + 1) / (len(row) + 1), ROW * (i + 1) - HEIGHT)
    key = " ".join(f'<tspan fill="{colour}">■ {name}</tspan>' for name, colour in colours.items())
    parts = [
        f'<svg viewBox="0 0 {WIDTH:g} {ROW * len(rows) + 20:g}" role="img" style="max-width:100%">',
        "<title>Packages and what they use; an arrow points down at what is used</title>",
        f'<text x="4" y="14" font-size="13" font-family="sans-serif" fill="currentColor">{key}</text>',
    ]
    for a, b in arrows:
        (x, y), (u, v) = at[a], at[b]
        y, v = y + HEIGHT / 2, v - HEIGHT / 2
        bend = (v - y) / 2
        path = f"M{x:.0f} {y:.0f}C{x:.0f} {y + bend:.0f} {u:.0f} {v - bend:.0f} {u:.0f} {v:.0f}"
        parts.append(f'<path d="{path}" fill="none" stroke="currentColor" stroke-opacity="0.45"/>')
    for node, (x, y) in at.items():
        width, colour = CHAR * len(labels[node]) + GAP, colours[groups[node]]
        parts.append(
            f'<rect x="{x - width / 2:.0f}" y="{y - HEIGHT / 2:.0f}" width="{width:.0f}" '
            f'height="{HEIGHT:g}" rx="4" fill="{colour}"/><text x="{x:.0f}" y="{y + 4:.0f}" '
            f'font-size="12" font-family="sans-serif" text-anchor="middle" fill="#ffffff">'
            f"{html.escape(labels[node])}</text>"
        )
    return "\n".join([*parts, "</svg>"])
