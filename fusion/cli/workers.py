"""Options of the commands that compute on the processes of this machine or on a Dask cluster."""

from __future__ import annotations

from typing import Annotated

import typer

JobsOption = Annotated[
    int | None,
    typer.Option(min=1, help="Processes on this machine; by default one a processor.", show_default=False),
]
BackendOption = Annotated[str, typer.Option(help="loky: this machine; dask: a cluster.")]
AddressOption = Annotated[
    str | None, typer.Option(metavar="tcp://HOST:PORT", help="The Dask cluster's scheduler.")
]


def check_backend(backend: str, address: str | None) -> None:
    """Refuse wrong usage of `--backend` and `--address`, before any work."""
    from terrafusion.twin.executors import BACKENDS

    if backend not in BACKENDS:
        raise typer.BadParameter(
            f"'{backend}' is neither {' nor '.join(map(repr, BACKENDS))}", param_hint="--backend"
        )
    if (address is not None) != (backend == "dask"):
        raise typer.BadParameter("goes with --backend dask, which needs it", param_hint="--address")


def processes(jobs: int | None) -> int:
    """`--jobs`, or the number of processors."""
    import joblib

    return jobs if jobs is not None else int(joblib.cpu_count())
