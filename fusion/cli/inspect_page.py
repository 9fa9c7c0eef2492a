"""The page of `terrafusion inspect` as lines of text, at most 100 columns wide.

It is made of the data that `--json` prints.
"""

import textwrap
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import Any

from terrafusion.datasets.core.tables import text_table
from terrafusion.fusion.cli.common import Line, styled

CENTURY_NS = (946_684_800 * 10**9, 4_102_444_800 * 10**9)
"""Of the years 2000 to 2099."""

WIDTH = 100
INDENT = 10
LONG_STEP_M = 2.0
"""Longer steps cut the turns of a robot."""
MOST_WORDS = 12
GLUE = "\N{NO-BREAK SPACE}"


def print_lines(lines: Iterable[Line]) -> None:
    """Print, in colour where standard output is a terminal."""
    for line in lines:
        print(styled(line))


def contents_lines(page: dict[str, Any]) -> Iterator[Line]:
    """The page without its findings."""
    yield from _title(page)
    yield from _channels(page["channels"])
    measured = list(measured_texts(page["measured"]))
    if measured:
        yield "", ""
    for name, text in measured:
        yield from entry(name, "", text)
    for note in page["notes"]:
        yield from entry("note", "dim", _note(note, page["recordings"]))


def _title(page: dict[str, Any]) -> Iterator[Line]:
    duration, count = page["duration_s"], page["recordings"]
    if count == 1:
        about = [f"{duration:.1f} s", _utc(page["start_ns"])]
    else:
        about = [f"{count} recordings of {_spread(duration, 'g')} s, {duration['total']:.0f} s in all"]
    for key in ("vehicle", "terrain"):
        value = page[key]
        if isinstance(value, dict):
            value = ", ".join(f"{word} {count}" for word, count in value.items())
        about += [f"{key} {value}"] if value else []
    yield from _wrapped(page["name"], "bold", f"  {'; '.join(about)}", 4)
    origin = [text for text in (page["licence"] and f"licence {page['licence']}", page["source"]) if text]
    if origin:
        yield from _wrapped(" " * 3, "", f" {'; '.join(origin)}", 4)


def _channels(channels: dict[str, Any]) -> Iterator[Line]:
    yield from clock_table(channels)
    yield "", ""
    for name, c in channels.items():
        yield from entry(name, "", _ranges(c))


def clock_table(channels: dict[str, Any], head: str = "channel") -> Iterator[Line]:
    """Samples, rates and gaps of channels (or of topics), a row each."""
    pooled = any("recordings" in c for c in channels.values())
    heads = [
        head.ljust(INDENT - 2),
        "samples",
        "rate Hz",
        "recordings" if pooled else "span s",
        "gaps",
        "longest s",
    ]
    rows = []
    for name, c in channels.items():
        rate, gap = c["rate_hz"], c["longest_gap_s"]
        sampled = name != "terrain"  # labels are irregular
        rows.append([
            name,
            str(c["samples"]),
            "-" if not rate or not sampled else _spread(rate, ".4g") if pooled else f"{rate:.4g}",
            f"{c['recordings']}" if pooled else f"{c['start_s']:.1f} to {c['end_s']:.1f}",
            str(c["gaps"]) if sampled else "-",
            f"{gap:{'.2g' if gap < 100.0 else '.0f'}}" if c["gaps"] and sampled else "-",
        ])  # fmt: skip
    yield "", ""
    for number, line in enumerate(text_table(heads, rows, right=range(1, len(heads)))):
        yield ("bold" if number == 0 else ""), line


def _ranges(channel: dict[str, Any]) -> str:
    if "ranges" not in channel:
        path = "unknown" if channel["path_m"] is None else f"{channel['path_m']:.1f} m"
        return f"{', '.join(channel['holds']) or 'nothing to score'} of {channel['frame']}, path {path}"
    parts = []
    for column, values in channel["ranges"].items():
        if isinstance(values, dict):
            parts.append(f"{column}{GLUE}{_words(values)}")
        else:
            low, high = (format(value, "z.3g") for value in values)
            parts.append(_glued(f"{column} {low}" if low == high else f"{column} {low} to {high}"))
    return "; ".join(parts)


def _words(counts: dict[str, int]) -> str:
    """The most frequent words of a column."""
    frequent = sorted(counts, key=lambda word: -counts[word])[:MOST_WORDS]
    words = [_glued(f"{word[:40]} {counts[word]}") for word in counts if word in frequent]
    omitted = len(counts) - len(frequent)
    return ", ".join([*words, *([f"{omitted} more"] if omitted else [])])


def measured_texts(measured: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """What is measured between the channels: a word and a text each."""
    from terrafusion.datasets.checks.measures import RULER_SIGMAS

    gravity, yaw, sigma = measured["gravity"], measured["yaw"], measured["sigma_m"]
    if gravity:
        vector = ", ".join(f"{value:z.2f}" for value in gravity["mean_mps2"])
        text = f"({vector}) m/s2, size {gravity['size_mps2']:.2f}: along {gravity['axis']}"
        yield "gravity", f"{text}, {gravity['tilt_deg']:.1f} deg off"
    if yaw:
        track = yaw["effective_track_m"]
        width = f", effective track {track:.2f} m" if track else ""
        yield "yaw", f"gyro z against wheels: r {yaw['r']:.3f}{width} ({yaw['seconds']:.0f} s in common)"
    for name, ratio in measured["speed_ratio"].items():
        interval = f"{ratio['low']:.3f} to {ratio['high']:.3f}; {ratio['stretches']} stretches"
        yield "speed", f"{name} over wheels {ratio['ratio']:.3f} ({interval})"
    if measured["path_m"]:
        step_m = RULER_SIGMAS * sigma["median"] if sigma else 0.0
        cut = {"gnss": f" (in steps of {step_m:.0f} m, which cut its turns)"} if step_m > LONG_STEP_M else {}
        lengths = measured["path_m"].items()
        yield "path", ", ".join(f"{name} {length:.1f} m{cut.get(name, '')}" for name, length in lengths)
    if sigma:
        spread = f"{sigma['min']:.3g} to {sigma['max']:.3g} m, median {sigma['median']:.3g} m"
        yield "sigma", f"of the fixes, horizontal, {spread}"
    for lag in measured["lags"]:
        text = f"{lag['later']} after {lag['earlier']} by {lag['seconds']:.3f} s"
        interval = f"({lag['low_s']:.3f} to {lag['high_s']:.3f})"
        yield "lag", f"{text} {interval}, by the {lag['quantity']}, r {lag['r']:.2f}"
    for name, rate in measured["held"].items():
        yield "held", f"{name}: {rate['update_hz']:.3g} new values in {rate['rate_hz']:.3g} rows a second"


def _note(note: str | dict[str, Any], recordings: int) -> str:
    if isinstance(note, str):
        return note
    remarks = ["numbers vary"] if note["numbers_vary"] else []
    remarks += [f"{note['recordings']} of {recordings}"] if note["recordings"] < recordings else []
    return f"{note['note']} ({_glued(', '.join(remarks))})" if remarks else str(note["note"])


def finding_lines(page: dict[str, Any]) -> Iterator[Line]:
    """The findings of the page."""
    yield "", ""
    without_wheels = "wheels" not in page["channels"]
    if without_wheels:
        yield from entry("missing", "yellow", "wheels, which replay and init need")
    if not page["findings"]:
        yield "green", "no findings in the other channels" if without_wheels else "no findings"
    for f in page["findings"]:
        style = "red" if f["severity"] == "error" else "yellow"
        yield from entry(f["severity"], style, f"{f['channel']}: {f['what']} [{f['code']}]")
        if "recordings" in f:
            yield from entry("", "", f"in {f['recordings']} of {page['recordings']}, first in #{f['first']}")
        yield from entry("", "", f["evidence"])
        remedy = "convert --apply-fixes" if f["repairable"] else "to do"
        yield from entry("", "", f"{_glued(remedy)}: {f['fix']}")


def entry(name: str, style: str, text: str) -> Iterator[Line]:
    """A word in a style of its own, and its text beside it."""
    yield from _wrapped(name.ljust(INDENT - 1), style, f" {text}", INDENT)


def _wrapped(head: str, style: str, text: str, indent: int) -> Iterator[Line]:
    """`head` and `text` on as many lines as needed; glued words stay on one line."""
    lines = textwrap.wrap(
        head.replace(" ", GLUE) + text, WIDTH, subsequent_indent=" " * indent, break_on_hyphens=False
    )
    for number, line in enumerate(lines):
        yield (style if number == 0 else ""), line.replace(GLUE, " ")


def _glued(text: str) -> str:
    return text.replace(" ", GLUE)


def _spread(values: dict[str, float], form: str) -> str:
    low, middle, high = (format(values[key], form) for key in ("min", "median", "max"))
    return middle if low == high else f"{middle} ({low} to {high})"


def _utc(start_ns: int) -> str:
    if start_ns >= CENTURY_NS[0]:
        return f"start {datetime.fromtimestamp(start_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    for unit, size_ns in (("s", 10**9), ("ms", 10**6), ("us", 10**3)):
        if CENTURY_NS[0] <= start_ns * size_ns < CENTURY_NS[1]:
            meant = datetime.fromtimestamp(start_ns * size_ns // 10**9, UTC).date()
            return f"start {start_ns / 1e9:.3f} s after 1970; if start_ns is given in {unit}: {meant}"
    return f"start {start_ns / 1e9:.3f} s (no calendar time)"
