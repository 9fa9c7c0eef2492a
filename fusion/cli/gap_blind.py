"""`terrafusion gap-blind`: the diagnosis judged on blind trials of a plant that is not the twin."""

import math
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.outputs import Output

OUTPUT = Output(
    "Folder for blind.json, report.html and the labels.",
    ("config.json", "labels.*", "commitment.json", "answers", "oracle", "blind.json", "report.html"),
    ("labels.salt",),
    goes_on=True,
)


def gap_blind(
    out: Path,
    quick: bool = False,
    share: Annotated[
        float, typer.Option(min=0.01, max=1.0, help="Of the trials of every family in the full check.")
    ] = 1.0,
    jobs: Annotated[int, typer.Option(min=1, help="Trials that are diagnosed at once.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of the trials; the same seed makes the same ones.")] = 0,
    backend: common.BackendOption = "loky",
    address: common.AddressOption = None,
    minutes: Annotated[
        float | None, typer.Option(min=0.0, help="Begin no trial later, and score those answered by then.")
    ] = None,
    opponent: Annotated[
        bool, typer.Option("--opponent/--no-opponent", help="Joint least squares on the same trials.")
    ] = True,
) -> Result:
    """Judge the gap diagnosis on trials whose truth it is not given, and which is fixed before the answers.

    The trials come from a plant with laws and integrator of its own. Stopped, the same command continues.
    Writes commitment.json first, answers, then blind.json and report.html.

    Examples:

      terrafusion gap-blind --quick --out blind

      terrafusion gap-blind --share 0.2 --jobs 2 --out blind

      terrafusion gap-blind --backend dask --address tcp://10.0.0.5:8786 --jobs 16 --out blind

    Args:
        quick: A small subset: every family, few trials.
    """
    from terrafusion.fusion.reports.blind import summary, write_blind
    from terrafusion.twin.gap import diagnose
    from terrafusion.twin.gap.blind.answers import Pool
    from terrafusion.twin.gap.blind.check import run_blind_check
    from terrafusion.twin.gap.blind.opponent import joint_least_squares
    from terrafusion.twin.gap.blind.plan import FULL, QUICK

    if quick and share < 1.0:
        raise typer.BadParameter("a quick check has its own size", param_hint="--share")
    common.check_backend(backend, address)
    # Processes, or threads inside.
    judged = partial(diagnose, jobs=1) if jobs > 1 or backend == "dask" else diagnose
    with common.progress_bar("diagnosing") as progress:
        scores = run_blind_check(
            out,
            judged,
            scale=QUICK if quick else FULL.part(share),
            seed=seed,
            pool=Pool(jobs, backend, address),
            progress=progress,
            oracle=judged,
            opponent=joint_least_squares if opponent else None,
            minutes=math.inf if minutes is None else minutes,
        )
    write_blind(out, scores, {"command": common.command_line()})
    return Result(summary(scores), f"written to {out}", common.read_json(out / "blind.json"))
