"""The unit of severity: the size at which an effect is detected half of the time.

A point has two factors: how effects compare, measured by an observer that is independent of the diagnosis,
and one number a kind of drive for the diagnosis itself. `python -m tests.studies.blind.severity` and
`tests.studies.blind.power` measure them into `severity.yaml`.
"""

from __future__ import annotations

import functools
from importlib import resources
from typing import Any


def half_power(key: str, kind: str) -> float:
    """Size of the shape `key` that the diagnosis detects half of the time on drives of a kind.

    Raises:
        KeyError: the shape has no point.
    """
    return stored_points()["scale"][kind] * observed(key, kind)


def observed(key: str, kind: str) -> float:
    """The same of the observer.

    Raises:
        KeyError: the shape has no point.
    """
    return float(stored_points()["points"][key][kind])


@functools.cache
def stored_points() -> dict[str, Any]:
    """`severity.yaml`: `scale` by kind of drive, `points` by shape and kind."""
    from terrafusion.datasets.core.yaml_file import read_yaml

    with resources.as_file(resources.files("terrafusion.twin.gap.blind") / "severity.yaml") as path:
        return read_yaml(path)
