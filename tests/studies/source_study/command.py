"""Reproduce the study this project starts from, and judge the twin against it, statement by statement.

    python -m tests.studies.source_study.command --out DIR [--quick] [--seeds N] [--jobs N]

Runs mud, loose and medium sand, the batch over friction, slope and payload, and a drive like the field test.
Prints the tables; writes agreement.csv, metrics.json, batch.csv and report.html.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.studies.parts import add_worker_options
from tests.studies.source_study.report import write_study
from tests.studies.source_study.study import StudyPlan, run_study
from tests.studies.source_study.text import document_section, quoted_lines

MODULE = "python -m tests.studies.source_study.command"


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog=MODULE, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for tables and report")
    parser.add_argument("--quick", action="store_true", help="two seeds and a small batch")
    parser.add_argument("--seeds", type=int, help="seeds a case (10; 2 when quick)")
    add_worker_options(parser)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    plan = StudyPlan(seeds=given.seeds, quick=given.quick, jobs=given.jobs)
    study = run_study(plan, _progress, backend=given.backend, address=given.address)
    words = [MODULE, *(["--quick"] if plan.quick else []), f"--seeds {plan.seed_count()}"]
    write_study(given.out, study, {"command": " ".join(words)})
    print("\n".join([*document_section(study), "", *quoted_lines(study)]))
    return 0


def _progress(share: float) -> None:
    if sys.stderr.isatty():
        print(f"\r{share:.0%} of the runs", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
