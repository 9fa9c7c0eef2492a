"""The field logs as drives: the outages of the field table, with the true ground where a log tells it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.arms import known_labels, true_labels
from terrafusion.fusion.benchmark.drives import FIELD, Drive
from terrafusion.fusion.benchmark.outage_plan import aided_by_truth, until
from tests.studies.field_table.table import (
    Refusal,
    catalogued,
    check_log,
    each_drive,
    ground_of,
    outages_of,
    reference_of,
)

AID_SEED = 1
"""Of the noise on fixes that are made from truth."""
NOT_LABELLED = "not labelled"


@dataclass(frozen=True)
class Log:
    """A field log, and how many outages of each length it is to have at most."""

    name: str
    starts: int

    @property
    def key(self) -> str:
        """Its name as that of a file."""
        return f"{FIELD}-{self.starts}-{self.name.replace('/', '_').replace('#', '_')}"


def logs_at_hand(starts: int) -> list[Log]:
    """Logs of the catalogue whose files are there."""
    return [Log(name, starts) for name in catalogued()]


def drives_of(log: Log) -> list[Drive | Refusal]:
    """All drives of a log; `plant` is its ground: "firm", "slipping" or `NOT_LABELLED`."""
    return each_drive(log.name, lambda name, _, recording: _drives(log, name, recording))


def _drives(log: Log, name: str, recording: Recording) -> Iterator[Drive]:
    check_log(recording)
    reference = reference_of(recording)
    ground = ground_of(log.name, recording) or NOT_LABELLED
    labels = known_labels(true_labels(recording))
    whole = Drive(FIELD, ground, name, f"{name}, whole", recording, None, labels)
    if reference == "none":
        yield dataclasses.replace(whole, judged=False)
        return
    if reference == "truth" and recording.gnss is None:
        recording = aided_by_truth(recording, AID_SEED)
    outages = outages_of(recording, log.starts)
    if not outages:
        yield whole
    for outage in outages:
        yield dataclasses.replace(
            whole,
            name=f"{name}, {outage.seconds:g} s from {outage.start_s:.1f} s",
            recording=until(recording, outage.start_s + outage.seconds + 0.5),
            outage=outage,
        )
