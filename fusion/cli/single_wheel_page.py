"""The page of `terrafusion inspect` for single-wheel trials."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from terrafusion.fusion.cli.inspect_page import Line


def trials_of(log: str) -> dict[str, Any] | None:
    """Summary of the trials at `log` as plain data; None where the log has another format.

    Raises:
        TerrafusionError: the log cannot be read.
    """
    from terrafusion.datasets.catalog.catalog import load_catalog
    from terrafusion.datasets.core.errors import DataError
    from terrafusion.datasets.readers.formats import format_of
    from terrafusion.datasets.readers.open import find_log
    from terrafusion.datasets.readers.sets.single_wheel import read_wheel_trials

    path, number = find_log(log)
    if format_of(path).name != "single_wheel_mat":
        return None
    if number is not None:
        raise DataError("trials have no numbers", file=path, remedy=f"leave #{number} out")
    trials = read_wheel_trials(path)
    entry = load_catalog().find(path)
    return {
        "name": path.stem,
        "kind": "single-wheel trials",
        "licence": load_catalog().sets[entry.set_name].licence if entry else None,
        **trials.summary(),
        "notes": list(trials.notes),
    }


def trials_lines(page: dict[str, Any]) -> Iterator[Line]:
    """The page as lines of text; angles in degrees."""
    import numpy as np

    licence = f"; licence {page['licence']}" if page["licence"] else ""
    yield "bold", f"{page['name']}  {page['trials']} trials of a single wheel{licence}"
    yield "", f"          {page['driven']} driven, {page['braked']} braked"
    yield "", ""
    angles = ", ".join(f"{angle:.0f}" for angle in np.degrees(page["commanded_side_slip_rad"]))
    yield "", f"side-slip commanded at {angles} deg"
    for name, span in page.items():
        if isinstance(span, tuple) and not name.startswith("commanded"):
            low, high = np.degrees(span) if name.endswith("_rad") else span
            unit = name.replace("_rad", "_deg")
            yield "", f"{unit:20} {low:8.3g} to {high:.3g}"
    for note in page["notes"]:
        yield "dim", f"note      {note}"
    yield "", ""
    yield "", "read them with terrafusion.datasets.readers.sets.single_wheel.read_wheel_trials"
