"""Commands that are killed, interrupted or run on a troubled machine: is a half file taken for whole?

    python -m tests.studies.kills.kills --kills 50 --out OUT

Each long command runs in a child process and is ended by SIGKILL, every fifth time by SIGINT, half of them
before one of its file operations, half after some of its computing time, drawn at random with a seed. Every
file it left must then be whole or bear the name of a part, a log folder must be refused or be the whole log.
After every few kills the same command must end well, with the files of an undisturbed run and nothing else.
Then each command meets a machine in trouble: it works, or says so in one line and leaves nothing half done.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import sys
from collections import Counter
from pathlib import Path

import numpy as np

from tests.studies.kills.child import End, ended, started
from tests.studies.kills.commands import COMMANDS, preload, prepared
from tests.studies.kills.leftovers import half_files, is_part, names_in
from tests.studies.kills.troubles import TROUBLES, TWO, troubled, two_at_once

RERUN_EVERY, INTERRUPT_EVERY = 5, 5


def reference_run(words: tuple[str, ...], work: Path) -> End:
    """An undisturbed run; its files are moved to `reference`.

    Raises:
        RuntimeError: it fails.
    """
    for name in ("out", "reference", "tmp"):
        shutil.rmtree(work / name, ignore_errors=True)
    (work / "out").mkdir()
    end = ended(started(words, work), work)
    if end.status:
        raise RuntimeError(f"{' '.join(words)}: {end.status} {end.err[-2000:]}")
    (work / "out").rename(work / "reference")
    (work / "out").mkdir()
    return end


def killed(name: str, work: Path, kills: int, seed: int = 0) -> Counter[str]:
    """Ends a command `kills` times; counts what went wrong, and prints it."""
    words, rng, count = COMMANDS[name], np.random.default_rng([seed, len(name)]), Counter[str]()
    clean = reference_run(words, work)
    out, reference = work / "out", work / "reference"
    for i in range(kills):
        sign = signal.SIGINT if i % INTERRUPT_EVERY == INTERRUPT_EVERY - 1 else signal.SIGKILL
        event = int(rng.integers(1, clean.events + 1)) if i % 2 == 0 else 0
        after_s = 0.0 if event else float(rng.uniform(0.02, 1.0)) * clean.cpu_s
        end = ended(started(words, work, event, sign), work, after_s, sign)
        count["kills"] += 1
        count["ended before"] += end.status == 0
        at = f"{name}, {'SIGINT' if sign == signal.SIGINT else 'SIGKILL'} " + (
            f"before file operation {event} of {clean.events}" if event else f"after {after_s:.2f} s"
        )
        if end.status not in (0, -sign, 130) or "Traceback" in end.err:
            _wrong(count, "odd end", f"{at}: {end.status} {end.err[-300:]}")
        for path in half_files(out, reference):
            _wrong(count, "half files", f"{at}: {path}")
        if i % RERUN_EVERY == RERUN_EVERY - 1 or i == kills - 1:
            _rerun(words, work, count, at)
    return count


def _rerun(words: tuple[str, ...], work: Path, count: Counter[str], at: str) -> None:
    """The same command once more, and its files against the undisturbed ones."""
    end = ended(started(words, work), work)
    count["reruns"] += 1
    if end.status:
        _wrong(count, "rerun fails", f"{at}: {end.err[-300:]}")
    elif bad := [*half_files(work / "out", work / "reference")]:
        _wrong(count, "half files", f"{at}, rerun: {bad}")
    elif names_in(work / "out") != names_in(work / "reference"):
        odd = names_in(work / "out") ^ names_in(work / "reference")
        _wrong(count, "left behind", f"{at}, rerun: {sorted(odd)[:5]}")
    left = [
        path.name
        for path in [*(work / "tmp").iterdir(), *(work / "out").iterdir()]
        if is_part(Path(path.name))
    ]
    if left:
        _wrong(count, "left behind", f"{at}, rerun: {left[:5]}")
    shutil.rmtree(work / "out")
    (work / "out").mkdir()


def _wrong(count: Counter[str], kind: str, what: str) -> None:
    count[kind] += 1
    print(f"{kind}: {what}", file=sys.stderr, flush=True)


def main() -> None:
    """Print the table of kills and that of troubles."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--commands", nargs="*", default=list(COMMANDS))
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    work, kept = prepared(given.out.absolute() / "work"), given.out / "rows.json"
    preload(work)
    rows = json.loads(kept.read_text()) if kept.is_file() else {}
    for name in given.commands:
        row = rows.setdefault(name, {"troubles": {}})
        if "count" not in row:
            row["count"] = killed(name, work, given.kills)
            kept.write_text(json.dumps(rows))
        if missing := [what for what in (*TROUBLES, TWO) if what not in row["troubles"]]:
            reference_run(COMMANDS[name], work)
            for what in missing:
                two = what == TWO
                row["troubles"][what] = (
                    two_at_once(name, work) if two else troubled(name, work, TROUBLES[what])
                )
            kept.write_text(json.dumps(rows))
    print(table(rows))


BAD = ("odd end", "half files", "rerun fails", "left behind")


def table(rows: dict[str, dict[str, dict[str, str | int]]]) -> str:
    """Counts of kills, then of troubles."""
    counts = {name: Counter(row["count"]) for name, row in rows.items()}
    total = sum(counts.values(), Counter[str]())
    lines = [f"kills {total['kills']}", f"defects {sum(total[what] for what in BAD)}"]
    troubles = [told for row in rows.values() for told in row["troubles"].values()]
    odd = [told for told in troubles if told not in ("works", "refused", "not tried")]
    lines += [f"troubles {len(troubles)}", f"troubles that end oddly {len(odd)}", ""]
    names = ("kills", "ended before", "reruns", *BAD)
    lines += ["| command | " + " | ".join(names) + " |", "| --- " * (len(names) + 1) + "|"]
    lines += [
        f"| {name} | " + " | ".join(str(count[n]) for n in names) + " |" for name, count in counts.items()
    ]
    columns = (*TROUBLES, TWO)
    lines += ["", "| command | " + " | ".join(columns) + " |", "| --- " * (len(columns) + 1) + "|"]
    lines += [
        f"| {name} | " + " | ".join(str(row["troubles"][c]) for c in columns) + " |"
        for name, row in rows.items()
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
