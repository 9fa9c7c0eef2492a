"""`terrafusion benchmark`: adaptive weighting against fixed and other baselines, in pairs."""

from pathlib import Path
from typing import Annotated

import typer

from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.outputs import Output

OUTPUT = Output(
    "Folder for the results; an interrupted benchmark continues.",
    ("config.json", "parts", "benchmark.json", "benchmark.md", "report.html"),
    ("parts",),
    goes_on=True,
)


def benchmark(
    out: Path,
    quick: bool = False,
    jobs: common.JobsOption = None,
    backend: common.BackendOption = "loky",
    address: common.AddressOption = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Runs of each family on each plant (20).", show_default=False)
    ] = None,
    only: list[str] | None = None,
    docs: Path | None = None,
) -> Result:
    """Compare weighting methods on the same runs: twin, perturbed soils, other terramechanics, field logs.

    Methods: data sheet, fixed (tuned), robust, innovation, adaptive, and adaptive with true, shuffled and
    adversarial ground labels. Writes benchmark.json, benchmark.md and report.html.

    Example: terrafusion benchmark --out results --quick

    Args:
        quick: Few runs: two minutes on two processors.
        only (FAMILY[=SEEDS]): mixed, slopes, outages, firm, unseen, field; repeat for more.
        docs (FILE): Put the tables into a document that has the mark line.
    """
    from terrafusion.fusion.benchmark.plan import BenchmarkPlan, families_of
    from terrafusion.fusion.benchmark.run import run_benchmark
    from terrafusion.fusion.reports.benchmark import (
        at_the_end,
        document_head,
        origin_of,
        write_benchmark,
        write_document,
    )

    common.check_backend(backend, address)
    plan = BenchmarkPlan(families_of(only or []), seeds, quick)
    words = ["--quick"] if quick else []
    words += [f"--seeds {seeds}"] if seeds else []
    words += [f"--only {name}" for name in only or []]
    command = " ".join(["terrafusion benchmark --out DIR", *words])
    origin = origin_of(plan, command)
    if docs is not None:
        document_head(docs)  # refuse now, not after hours
    with common.progress_bar("benchmark") as progress:
        result = run_benchmark(
            plan, out, jobs=common.processes(jobs), backend=backend, address=address, progress=progress
        )
    origin = at_the_end(origin)
    made = write_benchmark(out, result, origin)
    if docs is not None:
        write_document(docs, made, result, origin)
    lines = [line for table in made[:3] for line in [*table.markdown(), ""]]
    return Result(lines, f"report: {out / 'report.html'}", common.read_json(out / "benchmark.json"))
