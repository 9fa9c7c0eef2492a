"""A diagnosis in words: one screen with the verdict first, and the details behind it; and what an effect of
the catalogue is, its laws, and how to check it on the robot.
"""

import functools
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path

from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.twin.effects.catalogue import forms_of, lookup
from terrafusion.twin.effects.form import NOMINAL_KG, NOMINAL_RADIUS_M
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.answer.next_run import BY_HAND
from terrafusion.twin.gap.answer.verdict import MOST_LEFT, Cause, CredibleSet
from terrafusion.twin.gap.answer.where import LEAST_REFERENCES, GapCell
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_UNITS

WIDTH, LINES = 100, 24
"""Columns and lines of the screen that `answer` fits."""
MOST_PLACES, MOST_NAMES, MOST_LISTED = 3, 4, 12
MOST_CANDIDATES = 10  # effects in a set beyond which it names none
END = 0.99  # share of a range from which a size is its end
TITLE = 9  # columns of a section's title


def answer(d: GapDiagnosis, out: Path | None = None, corrected: Path | None = None) -> list[str]:
    """Lines of one screen, at most `LINES` of `WIDTH`: verdict, where, which, how far it shrinks, what next;
    the last says how many were left out.

    `out` is the folder of the files, `corrected` the vehicle file that was written.
    """
    for most in range(MOST_PLACES, 0, -1):
        lines = _screen(d, out, corrected, most)
        if len(lines) <= LINES:
            break
    more = len(lines) - LINES + 1
    return lines if more < 2 else [*lines[: LINES - 1], f"... and {more} lines more, in the report"]


def sections(d: GapDiagnosis, corrected: Path | None = None, most: int = MOST_PLACES) -> dict[str, list[str]]:
    """Sentences by title, none without any; at most so many places, explained effects and channels."""
    lost = [note for note in d.notes if "left out" in note]
    found = {
        "Where": _places(d, most), "Which": _which(d, most), "Shrinks": _shrinks(d, most), "Next": _next(d),
        "Load": _load(corrected) if d.verdict.named else [], "Runs": [_compared(d), *lost],
    }  # fmt: skip
    return {title: sentences for title, sentences in found.items() if sentences}


def _screen(d: GapDiagnosis, out: Path | None, corrected: Path | None, most: int) -> list[str]:
    found = sections(d, corrected, most)
    if out is not None:
        found["Details"] = [f"{out / 'report.html'}, {out / 'diagnosis.json'}; here with --verbose"]
    lines = textwrap.wrap(verdict_line(d), WIDTH, break_on_hyphens=False)
    for title, sentences in found.items():
        for i, sentence in enumerate(sentences):
            first = (title if i == 0 else "").ljust(TITLE)
            lines += textwrap.wrap(
                sentence, WIDTH, initial_indent=first, subsequent_indent=" " * TITLE, break_on_hyphens=False
            )
    return lines


def verdict_line(d: GapDiagnosis) -> str:
    """The verdict in words, with its certainty."""
    verdict, sets = d.verdict, named_sets(d)
    limited = d.drives is not None and d.drives.limits()
    if verdict.kind == "no_gap":
        if d.detection.p_value <= d.significance:
            other = "and so do the drives" if limited else "but no effect differs from zero for sure"
            if not limited and d.evidence.patchier is not None:
                other = "and so does the ground, which varies more along the path"
            return f"Undecided: the runs differ from the references, {other} ({_test(d)})."
        if d.drives is not None and limited:
            covered = f"which cover {percent(d.drives.covered)} of the time of these drives"
            return f"No gap as far as the references tell, {covered} ({_test(d)})."
        if d.evidence.patchier is not None:
            return f"No gap, but the ground varies more along the path than the references' ({_test(d)})."
        like = "the references among themselves" if d.references else "the twin's own runs"
        return f"No gap: the runs differ no more than {like} ({_test(d)})."
    if verdict.kind == "unknown":
        certain = _certain(d, verdict.p_unknown)
        return f"Gap of unknown cause: no effect of the catalogue explains it ({certain})."
    certain = _certain(d, sets[0].probability) if sets else "not certain"
    if verdict.kind == "parameters":
        own = next(c.probability for c in verdict.causes if c.effect in verdict.named)
        certain = _certain(d, own)  # not of what it resembles
        return f"Gap caused by the ground, which has changed; no effect is missing ({certain})."
    if (most := max(len(s.effects) for s in sets)) > MOST_CANDIDATES:
        return f"Gap whose cause these drives do not show: any of {most} effects fits ({certain})."
    if len(sets) > 1:
        both = "; and ".join(map(alternatives_text, sets))
        return f"Gap caused by {len(sets)} effects together ({certain}): {both}."
    return f"Gap caused by {alternatives_text(sets[0], certain)}."


def _certain(d: GapDiagnosis, probability: float) -> str:
    """A probability, with its condition where too few references show the errors of the twin."""
    return f"{percent(probability)} certain{', if the twin is right' if d.uncalibrated else ''}"


def named_sets(d: GapDiagnosis) -> list[CredibleSet]:
    """Credible sets of the named effects."""
    return [s for s in d.verdict.sets if s.named]


def place_words(cell: GapCell) -> str:
    """A place of the gap, root mean squares in physical units: "yaw_rate while turning, slow, ..."."""
    unit = CHANNEL_UNITS[cell.channel]
    return (
        f"{cell.channel} while {cell.regime}, {cell.band}: {cell.error:.2g} {unit} "
        f"({cell.sigmas:.1f} sigma), references {cell.reference:.2g} {unit}"
    )


def numbers(d: GapDiagnosis, cause: Cause) -> str:
    """A cause's parameters with one sigma."""
    c, parts = d.evidence.candidates, []
    for i, value, sigma in zip(cause.columns, cause.value, cause.sigma, strict=True):
        unit = f" {c.units[i]}" if c.units[i] else ""
        known = math.isfinite(sigma)
        within = f"+- {_digits(sigma * c.scale[i], 2)}{unit}" if known else f"{unit} (fit failed)".strip()
        end = ", the end of its range" if _at_end(d, i, value) else ""
        parts.append(f"{c.keys[i]} = {_digits(value * c.scale[i], 3)} {within}{end}")
    return ", ".join(parts)


def _law(d: GapDiagnosis, cause: Cause) -> str:
    """The equation of a cause; where it has one parameter, its value is e."""
    keys = d.evidence.candidates.keys
    form, _ = lookup(keys[cause.columns[0]])
    return form.equation + ("; e is the value" if len(form.parameters) == 1 else "")


def _at_end(d: GapDiagnosis, column: int, value: float) -> bool:
    """Whether a size, in typical ones, is an end of its range."""
    low, high = (END * end[0] for end in d.evidence.candidates.bounds((column,)))
    return bool(value <= low < 0.0 or value >= high > 0.0)


def _digits(value: float, count: int) -> str:
    """A number with so many digits, and no power of ten below a million."""
    text = f"{value:.{count}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text


def details(d: GapDiagnosis) -> list[str]:
    """What the screen leaves out: more places and ranked causes, the test, and assumptions."""
    runs, references = counted(len(d.runs), "run"), counted(len(d.references), "reference")
    lines = [f"{runs}, {d.seconds:.0f} s; {references}; {_test(d)}"]
    lines += [
        f"where: {place_words(c)}; {percent(c.share)} of the gap (p = {c.p_value:.2g})"
        for c in significant_places(d)[:MOST_LISTED]
    ]
    for cause in d.verdict.causes[:MOST_LISTED]:
        share = "" if cause.share is None else f", explains {percent(cause.share)} of what the best do"
        lines.append(f"cause: {cause.effect}, {percent(cause.probability)}{share} ({numbers(d, cause)})")
    s = d.shrinkage
    floor = "" if s.floor is None else f", references {s.floor:.3g}"
    lines.append(
        f"mean squared error in noise variances: before {s.before:.3g}, after {s.after:.3g}{floor}, with "
        f"ground and sensor offsets refitted instead {s.recalibrated:.3g}"
    )
    return [*lines, *(f"note: {note}" for note in d.notes)]


def significant_places(d: GapDiagnosis) -> list[GapCell]:
    """Cells of the gap map that are significant, most important first."""
    return [c for c in d.where if c.p_value <= d.significance]


def percent(share: float) -> str:
    """A share as "97 %", never as 0 or 100 %."""
    return "over 99 %" if share > 0.995 else "under 1 %" if share < 0.005 else f"{100.0 * share:.0f} %"


def _test(d: GapDiagnosis) -> str:
    return f"p = {d.detection.p_value:.2g}, threshold {d.significance:g}"


def alternatives_text(s: CredibleSet, certain: str = "") -> str:
    """ "A, B or C, which these drives cannot tell apart"."""
    more = len(s.effects) - MOST_NAMES
    names = [*s.effects[:MOST_NAMES], *([f"{more} more"] if more > 0 else [])]
    after = f" ({certain})" if certain else ""
    if len(names) == 1:
        return names[0] + after
    return f"{', '.join(names[:-1])} or {names[-1]}{after}, which these drives cannot tell apart"


def _compared(d: GapDiagnosis) -> str:
    """What was judged beside what, so that a reference given as a run is seen."""
    judged = f"judged: {_some(d.runs)}"
    return f"{judged}; references: {_some(d.references)}" if d.references else f"{judged}; no references"


def _some(names: Sequence[str]) -> str:
    """ "a, b, c and 9 more"."""
    more = len(names) - MOST_NAMES
    return ", ".join(names[:MOST_NAMES]) + (f" and {more} more" if more > 0 else "")


def _places(d: GapDiagnosis, most: int) -> list[str]:
    if not d.detected:
        return []
    if len(d.references) < LEAST_REFERENCES:
        return [f"unknown: that takes {LEAST_REFERENCES} references"]
    places: dict[tuple[str, str], GapCell] = {}
    for cell in significant_places(d):  # the more important band of each
        places.setdefault((cell.channel, cell.regime), cell)
    if not places:
        return ["in no single channel and regime significant"]
    return [place_words(cell) for cell in [*places.values()][:most]]


def _which(d: GapDiagnosis, most: int) -> list[str]:
    """Sizes of the named effects; what they and their look-alikes are, and how to check them."""
    by_name = {cause.effect: cause for cause in d.verdict.causes}
    if any(len(s.effects) > MOST_CANDIDATES for s in named_sets(d)):
        return ["not shown by these drives: sizes and probabilities of all are in the report"]
    lines = [f"{numbers(d, by_name[name])} ({_law(d, by_name[name])})" for name in d.verdict.named]
    words = effect_words()
    names = list(dict.fromkeys(n for s in named_sets(d) for n in s.effects if n in words))
    lines += [f"{n}: {words[n][0]} To check: {words[n][1]}" for n in names[:most]]
    if len(names) > most:
        lines.append("the others: terrafusion gap --explain EFFECT")
    if d.verdict.kind == "unknown" and d.verdict.causes:
        first = d.verdict.causes[0]
        lines.append(f"nearest is {first.effect} ({numbers(d, first)}), which leaves too large a residual")
    return lines


def _shrinks(d: GapDiagnosis, most: int) -> list[str]:
    s = d.shrinkage
    if not d.verdict.named:
        return []
    if s.floor is None:
        how = "by an unknown share: there are no references to compare with"
    elif s.share is None:
        how = "by an unknown share: with ground and offsets refitted, samples differ as references do"
        if d.verdict.left is None:
            how += ", and so do whole runs; doubt the cause"
        elif d.verdict.left > MOST_LEFT:
            how += "; doubt the cause"
        else:
            how += f". Of the gap over whole runs the cause explains {percent(1.0 - d.verdict.left)}"
    else:
        interval = (
            "" if s.interval is None else f" (95 %: {100 * s.interval[0]:.0f} to {100 * s.interval[1]:.0f} %)"
        )
        data = "on runs held out of the fit" if len(d.runs) > 1 else "on the run it was fitted to"
        how = f"by {100.0 * s.share:.0f} %{interval} with it in the twin, {data}"
        if s.interval is not None and s.interval[0] <= 0.0:
            how += ", perhaps not at all: doubt the cause"
        elif (s.share if s.interval is None else s.interval[1]) < 1.0 - MOST_LEFT:
            how += "; most of it is left, so there is another cause, or another law"
    order = sorted(s.physical, key=lambda name: -abs(s.channels[name][0] - s.channels[name][1]))
    parts = []
    for name in order[:most]:
        before, after, floor = s.physical[name]
        base = "" if floor is None else f", references {floor:.2g}"
        parts.append(f"{name} {before:.2g} -> {after:.2g} {CHANNEL_UNITS[name]}{base}")
    return [how, "; ".join(parts)]


def _next(d: GapDiagnosis) -> list[str]:
    lines = []
    if d.drives is not None and d.drives.limits():
        covered, missing = percent(d.drives.covered), "; ".join(d.drives.missing)
        lines.append(
            f"Your drives differ from your references (these cover {covered} of the time) in: "
            f"{missing}. Make these references and diagnose again."
        )
    if d.next_run is not None:
        what = d.next_run.scenario
        lines.append(f"{what if what == BY_HAND else f'drive {what!r}'}: {d.next_run.why}")
    if d.uncalibrated:
        lines.append(
            "drive more references: there are too few to calibrate the test, and twin replicates stand in"
        )
    return lines


def _load(corrected: Path | None) -> list[str]:
    if corrected is not None:
        return [f"terrafusion gap RUN... --vehicle {corrected} judges further runs with it in the twin"]
    return ["--write-vehicle FILE writes the vehicle file with it; load it with --vehicle FILE"]


@functools.cache
def effect_words() -> dict[str, list[str]]:
    """What each built-in effect is and how to check it, a sentence each, by name."""
    words = read_yaml(Path(__file__).with_name("effect_words.yaml"))
    return {name: [str(sentence) for sentence in pair] for name, pair in words.items()}


def explanation(effect: str) -> list[str]:
    """What an effect is, how to check it, its laws with typical sizes; a ConfigError for an unknown name."""
    forms = forms_of(effect)
    lines = [effect]
    if effect in effect_words():
        what, check = effect_words()[effect]
        lines += [f"  what: {what}", f"  check: {check}"]
    for form in forms:
        lines.append(f"  {form.key}: {form.equation} (source: {form.source})")
        for p in form.parameters:
            unit = f" {p.unit}" if p.unit else ""
            robot = f"; for {NOMINAL_KG:g} kg on wheels of {NOMINAL_RADIUS_M:g} m, in proportion to both"
            lines.append(
                f"    {form.parameter_key(p)}: typical {p.scale:g}{unit}, {p.low:g} to {p.high:g}{unit}"
                + (robot if p.grows else "")
            )
    return lines
