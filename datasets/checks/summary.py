"""Contents, measures and findings of recordings as plain data: what `terrafusion inspect --json` prints.

Numbers are in the unit of their key; None (null) is unknown. The keys are described in
docs/reference/conventions.md.
"""

import dataclasses
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from terrafusion.datasets.checks.finding import Finding
from terrafusion.datasets.checks.measures import Measures
from terrafusion.datasets.checks.timing import is_gap
from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.channels import Channel
from terrafusion.datasets.core.json_text import finite
from terrafusion.datasets.core.recording import Recording

BURST = 2.0
"""Samples whose median interval is so many times shorter than the mean one come in bursts."""


def summarise(recording: Recording, measures: Measures, findings: Sequence[Finding]) -> dict[str, Any]:
    """One recording."""
    return {
        "name": recording.name,
        "recordings": 1,
        "start_ns": recording.start_ns,
        "duration_s": recording.duration_s(),
        "vehicle": recording.vehicle,
        "terrain": recording.terrain_name or None,
        "description": recording.description or None,
        "licence": recording.licence or None,
        "source": recording.source or None,
        "datum": recording.datum,
        "metadata": recording.metadata,
        "channels": _channels(recording),
        "measured": finite(dataclasses.asdict(measures)),
        "notes": list(recording.notes),
        "findings": [finding.to_dict() for finding in findings],
    }


def summarise_all(
    name: str, recordings: Sequence[Recording], measures: Measures, findings: Sequence[Sequence[Finding]]
) -> dict[str, Any]:
    """Several recordings of one file, pooled; `findings` are those of each."""
    durations = [r.duration_s() for r in recordings]
    return {
        "name": name,
        "recordings": len(recordings),
        "duration_s": _spread(durations) | {"total": float(sum(durations))},
        "vehicle": _counted(r.vehicle for r in recordings),
        "terrain": _counted(r.terrain_name for r in recordings),
        "licence": _common(r.licence for r in recordings),
        "source": _common(r.source for r in recordings),
        "channels": _pooled([_channels(r) for r in recordings]),
        "measured": finite(dataclasses.asdict(measures)),
        "notes": _grouped_notes([r.notes for r in recordings]),
        "findings": _grouped_findings(findings),
    }


def _channels(recording: Recording) -> dict[str, dict[str, Any]]:
    start_ns = recording.start_ns
    found = {
        name: clock(start_ns, channel.t_ns) | {"ranges": _ranges(channel)}
        for name, channel in recording.channels().items()
    }
    truth = recording.truth
    if truth is not None and len(truth):
        with np.errstate(over="ignore"):  # huge numbers are a finding
            path_m = truth.path_length_m()
        found["truth"] = clock(start_ns, truth.t_ns) | {
            "holds": list(recording.truth_channels),
            "frame": recording.truth_frame,
            "path_m": path_m if np.isfinite(path_m) and np.isfinite(truth.position_m[:, 0]).any() else None,
        }
    return found


def clock(start_ns: int, t_ns: TimesNs) -> dict[str, Any]:
    """Samples, rate, span and gaps of times (N,) of a channel, N at least 1."""
    dt = np.diff(t_ns) * 1e-9
    period = float(np.median(dt)) if len(dt) else 0.0
    rate, mean = 1.0 / period if period > 0 else None, mean_rate_hz(t_ns)
    in_bursts = rate is not None and mean is not None and rate > BURST * mean
    return {
        "samples": len(t_ns),
        "rate_hz": mean if in_bursts else rate,
        "start_s": float(t_ns[0] - start_ns) * 1e-9,
        "end_s": float(t_ns[-1] - start_ns) * 1e-9,
        "gaps": int(is_gap(t_ns).sum()),
        "longest_gap_s": float(dt.max()) if len(dt) else None,
    }


def mean_rate_hz(t_ns: TimesNs) -> float | None:
    """Rate over the span without gaps: where stamps vary by the time on the way the median is too short."""
    held = np.diff(t_ns)[~is_gap(t_ns)] * 1e-9
    return len(held) / float(held.sum()) if held.sum() > 0.0 else None


def _ranges(channel: Channel) -> dict[str, Any]:
    """Smallest and largest number of a column, or the count of each word."""
    ranges: dict[str, Any] = {}
    for column, values in channel.columns().items():
        if values.dtype == object:
            ranges[column] = dict(sorted(Counter(map(str, values.tolist())).items()))
        elif (known := values[np.isfinite(values)]).size:
            ranges[column] = [float(known.min()), float(known.max())]
    return ranges


def _pooled(each: Sequence[dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    pooled = {}
    for name in dict.fromkeys(name for channels in each for name in channels):
        parts = [channels[name] for channels in each if name in channels]
        rates = [part["rate_hz"] for part in parts if part["rate_hz"] is not None]
        gaps = [part["longest_gap_s"] for part in parts if part["longest_gap_s"] is not None]
        pooled[name] = {
            "recordings": len(parts),
            "samples": sum(part["samples"] for part in parts),
            "rate_hz": _spread(rates) if rates else None,
            "gaps": sum(part["gaps"] for part in parts),
            "longest_gap_s": max(gaps, default=None),
        }
        if name == "truth":
            paths = [part["path_m"] for part in parts]
            pooled[name] |= {
                "holds": list(dict.fromkeys(word for part in parts for word in part["holds"])),
                "frame": _common(part["frame"] for part in parts),
                "path_m": None if None in paths else float(sum(paths)),
            }
        else:
            pooled[name]["ranges"] = _pooled_ranges([part["ranges"] for part in parts])
    return pooled


def _pooled_ranges(each: Sequence[dict[str, Any]]) -> dict[str, Any]:
    pooled: dict[str, Any] = {}
    for ranges in each:
        for column, found in ranges.items():
            known = pooled.get(column)
            if isinstance(found, dict):
                pooled[column] = dict(Counter(known or {}) + Counter(found))
            else:
                pooled[column] = (
                    found if known is None else [min(known[0], found[0]), max(known[1], found[1])]
                )
    return pooled


def _grouped_findings(each: Sequence[Sequence[Finding]]) -> list[dict[str, Any]]:
    """One entry per code and channel: the first such finding, the number of recordings, the first of them."""
    groups: dict[tuple[str, str], dict[str, Any]] = {}
    for number, findings in enumerate(each):
        seen = set()
        for finding in findings:
            key = finding.code, finding.channel
            group = groups.setdefault(key, finding.to_dict() | {"recordings": 0, "first": number})
            group["recordings"] += key not in seen
            seen.add(key)
    return sorted(groups.values(), key=lambda g: (g["severity"] != "error", -g["recordings"]))


def _grouped_notes(each: Iterable[Sequence[str]]) -> list[dict[str, Any]]:
    """Notes that differ only in numbers count as one; the first represents all."""
    groups: dict[str, dict[str, Any]] = {}
    for notes in each:
        for key, note in {re.sub(r"\d+(\.\d+)?", "#", note): note for note in notes}.items():
            group = groups.setdefault(key, {"note": note, "recordings": 0, "numbers_vary": False})
            group["recordings"] += 1
            group["numbers_vary"] |= note != group["note"]
    return list(groups.values())


def _spread(values: Sequence[float]) -> dict[str, float]:
    return {"min": float(min(values)), "median": float(np.median(values)), "max": float(max(values))}


def _counted(words: Iterable[str | None]) -> dict[str, int]:
    return dict(Counter(word for word in words if word))


def _common(words: Iterable[str]) -> str | None:
    """The word that all share, or None."""
    found = set(words)
    return found.pop() or None if len(found) == 1 else None
