"""`terrafusion inspect LOG`: what a log holds and what is odd about it, on one page."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terrafusion.fusion.cli.common import (
    LogArgument,
    StampsOption,
    TopicOption,
    VehicleOption,
    load_rig,
    open_log,
    rig_of,
)

if TYPE_CHECKING:
    from terrafusion.datasets.doctor import Finding
    from terrafusion.datasets.recording import Recording


def inspect(
    log: LogArgument,
    vehicle: VehicleOption = None,
    topic: TopicOption = None,
    stamps: StampsOption = "header",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Show channels, rates, gaps and ranges of a log, and what the input doctor finds.

    Examples:

      terrafusion inspect drive.bag --vehicle husky

      terrafusion inspect drive.mcap --topic imu=/imu/data_raw --topic wheels=/odom

      terrafusion inspect my_log_folder --json
    """
    from terrafusion.datasets.doctor import examine

    rig = load_rig(vehicle)
    recording = open_log(log, rig, topic, stamps)
    findings = examine(recording, rig_of(recording, rig))
    if as_json:
        print(json.dumps(summary(recording, findings), indent=2))
    else:
        _print_page(recording, findings)


def summary(recording: Recording, findings: list[Finding]) -> dict[str, Any]:
    """The page as plain data: numbers in the unit of their key, null where unknown."""
    import numpy as np

    from terrafusion.datasets.trajectory import Trajectory

    channels = {name: _channel(recording, name, c) for name, c in recording.channels().items()}
    truth: Trajectory | None = recording.truth
    if truth is not None and len(truth):
        with np.errstate(over="ignore"):
            path_m = truth.path_length_m()
        channels["truth"] = _clock(recording, truth.t_ns) | {
            "holds": list(recording.truth_channels),
            "frame": recording.truth_frame,
            "path_m": path_m if np.isfinite(path_m) else None,
        }
    return {
        "name": recording.name,
        "start_ns": recording.start_ns,
        "duration_s": recording.duration_s(),
        "vehicle": recording.vehicle,
        "terrain": recording.terrain_name or None,
        "datum": recording.datum,
        "channels": channels,
        "notes": list(recording.notes),
        "findings": [finding.to_dict() for finding in findings],
    }


def _channel(recording: Recording, name: str, channel: Any) -> dict[str, Any]:
    import numpy as np

    ranges: dict[str, Any] = {}
    for column, values in channel.columns().items():
        if values.dtype == object:
            words, counts = np.unique(values.astype(str), return_counts=True)
            ranges[column] = dict(zip(words.tolist(), counts.tolist(), strict=True))
        elif np.isfinite(values).any():
            ranges[column] = [float(np.nanmin(values)), float(np.nanmax(values))]
    return _clock(recording, channel.t_ns) | {"ranges": ranges}


def _clock(recording: Recording, t_ns: Any) -> dict[str, Any]:
    import numpy as np

    from terrafusion.datasets.doctor.timing import GAP_PERIODS, GAP_S

    dt = np.diff(t_ns) * 1e-9
    period = float(np.median(dt)) if len(dt) else 0.0
    return {
        "samples": len(t_ns),
        "rate_hz": 1.0 / period if period > 0 else None,
        "start_s": float(t_ns[0] - recording.start_ns) * 1e-9,
        "end_s": float(t_ns[-1] - recording.start_ns) * 1e-9,
        "gaps": int(((dt > GAP_PERIODS * period) & (dt > GAP_S)).sum()),
        "longest_gap_s": float(dt.max()) if len(dt) else None,
    }


def _print_page(recording: Recording, findings: list[Finding]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    page = summary(recording, findings)
    console = Console(highlight=False)
    about = [f"{page['duration_s']:.1f} s"]
    about += [f"{key} {page[key]}" for key in ("vehicle", "terrain") if page[key]]
    console.print(
        f"[bold]{escape(page['name'])}[/bold]  {escape(', '.join(about))}  {_utc(page['start_ns'])}"
    )
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    table.add_column("channel", no_wrap=True)
    for title in ("samples", "rate Hz", "span s", "gaps"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("ranges", overflow="fold")
    for name, c in page["channels"].items():
        rate = f"{c['rate_hz']:.4g}" if c["rate_hz"] else "-"
        span = f"{c['start_s']:.1f} to {c['end_s']:.1f}"
        gaps = f"{c['gaps']} ({c['longest_gap_s']:.2g} s)" if c["gaps"] else "0"
        gaps = "-" if name == "terrain" else gaps
        table.add_row(name, str(c["samples"]), rate, span, gaps, escape(_ranges(c)))
    console.print(table)
    for note in page["notes"]:
        console.print(f"note     {escape(note)}", style="dim", soft_wrap=True)
    for f in findings:
        style = "red" if f.severity == "error" else "yellow"
        console.print(f"[{style}]{f.severity:8}[/{style}] {escape(f'{f.channel}: {f.what}')}", soft_wrap=True)
        console.print(f"         {escape(f.evidence)}; {escape(f.fix)}", soft_wrap=True)
    if not findings:
        console.print("[green]no findings[/green]")


def _utc(start_ns: int) -> str:
    from datetime import UTC, datetime

    if start_ns < 10**18:
        return f"start {start_ns / 1e9:.3f} s (no calendar time)"
    return f"start {datetime.fromtimestamp(start_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _ranges(channel: dict[str, Any]) -> str:
    if "ranges" not in channel:
        path = "unknown" if channel["path_m"] is None else f"{channel['path_m']:.1f} m"
        return f"{', '.join(channel['holds'])} of {channel['frame']}, path {path}"
    lines = []
    for column, found in channel["ranges"].items():
        if isinstance(found, dict):
            lines.append(f"{column} {', '.join(f'{word} {count}' for word, count in found.items())}")
        else:
            lines.append(f"{column} {found[0]:.3g} to {found[1]:.3g}")
    return "\n".join(lines)
