"""`python -m tests.studies.twin_field DATA... --out DIR`: the twin against measured drives."""

from __future__ import annotations

import argparse
import csv
import json
import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from terrafusion.datasets.catalog.catalog import DATA_VARIABLE
from terrafusion.datasets.core.errors import DataError, TerrafusionError
from terrafusion.datasets.core.files import unwritable
from tests.studies.twin_field import plots, summary
from tests.studies.twin_field.compare import OTHER, POOLED, SAME, compare
from tests.studies.twin_field.slip import SlipRow, slip_rows
from tests.studies.twin_field.sources import SETS, read


def main() -> int:
    """Compare, print the tables, write the files; 0, or 1 after a known error."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.twin_field", description=__doc__)
    parser.add_argument(
        "data", nargs="*", type=Path,
        help=f"folder with the sets {', '.join(SETS)}, or logs; by default {DATA_VARIABLE}",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, help="folder for tables and figures")
    parser.add_argument("--no-plots", action="store_true", help="tables only")
    words = parser.parse_args()
    try:
        run(words.data or [_default()], words.out, figures=not words.no_plots)
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def run(data: list[Path], out: Path, *, figures: bool = True) -> None:
    """The whole comparison of the drives in `data`, written to `out`.

    Raises:
        TerrafusionError: nothing to compare, a log that cannot be read, or a folder that cannot be written.
    """
    started = time.monotonic()

    def progress(text: str) -> None:
        if sys.stderr.isatty():
            print(f"\r\x1b[K{time.monotonic() - started:5.0f} s  {text}", end="", file=sys.stderr, flush=True)

    drives = read(data, progress)
    _folder(out)
    lines: list[summary.Line] = []
    slips: list[tuple[str, SlipRow]] = []
    forks: list[dict[str, Any]] = []
    numbers: list[dict[str, Any]] = []
    for name, runs in drives.runs.items():
        results = compare(runs, lambda text, name=name: progress(f"{name}: {text}"))  # type: ignore[misc]
        scored = {str(recording) for r in results for recording in r.forks.recording}
        few = sorted({run.recording for run in runs} - scored)
        drives.left_out |= dict.fromkeys(few, "too few horizons of 5 s in which it drives")
        vehicle, own = runs[0].vehicle, summary.lines(name, results)
        lines += own
        forks += summary.fork_rows(name, results)
        numbers += summary.parameters(name, results)
        rows = slip_rows(results, vehicle.wheel.radius_m, vehicle.body.track_m)
        slips += [(name, row) for row in rows]
        if figures and results:
            progress(f"{name}: figures")
            plots.save_all(name, own, rows, results, out)
    progress("")
    if not lines:
        raise DataError("no drive is long enough to compare", file=data[0], remedy="give longer logs")
    try:
        _write(out, lines, forks, slips, numbers, drives.left_out)
    except OSError as error:
        raise unwritable(out, error) from None
    print(_report(lines, slips, drives.left_out, (SAME,)))
    print(f"all tables: {out / 'field.md'}")


def _report(
    lines: list[summary.Line],
    slips: list[tuple[str, SlipRow]],
    left_out: dict[str, str],
    schemes: tuple[str, ...],
) -> str:
    parts = [f"## Trained on: {scheme}\n\n{summary.markdown(lines, scheme)}" for scheme in schemes]
    parts.append(f"## Slip and effective track\n\n{summary.slip_markdown(slips)}")
    if left_out:
        parts.append("## Left out\n\n" + "".join(f"- {name}: {why}\n" for name, why in left_out.items()))
    return "\n".join(parts)


def _write(
    out: Path,
    lines: list[summary.Line],
    forks: list[dict[str, Any]],
    slips: list[tuple[str, SlipRow]],
    numbers: list[dict[str, Any]],
    left_out: dict[str, str],
) -> None:
    rows = list(summary.line_rows(lines))
    slip = [flat for name, row in slips for flat in summary.slip_table_rows(name, [row])]
    _csv(out / "field.csv", rows)
    _csv(out / "forks.csv", forks)
    _csv(out / "slip.csv", slip)
    everything = {"lines": rows, "slip": slip, "models": numbers, "left_out": left_out}
    (out / "field.json").write_text(json.dumps(everything, indent=1, allow_nan=False), encoding="utf-8")
    (out / "field.md").write_text(_report(lines, slips, left_out, (SAME, POOLED, OTHER)), encoding="utf-8")


def _csv(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    table = list(rows)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(table[0]) if table else [])
        writer.writeheader()
        writer.writerows(table)


def _folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(out, error) from None


def _default() -> Path:
    given = os.environ.get(DATA_VARIABLE)
    if not given:
        raise DataError("no logs are named", remedy=f"give a folder or logs, or set {DATA_VARIABLE}")
    return Path(given)


if __name__ == "__main__":
    sys.exit(main())
