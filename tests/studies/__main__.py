"""`python -m tests.studies`: run studies, keep their results, and hold the documents against them.

    python -m tests.studies list                  what there is, and what has been run
    python -m tests.studies run NAME... | --all   run; a study that has a result of this code is skipped
                  [--backend dask --address ...]  on a cluster: its trials, or the whole of a study without
    python -m tests.studies figures [--write]     do README and docs quote what the results hold?

A result is `results/NAME.json` (figures, command, commit, time), `results/NAME.md` (what was printed) and,
where the study draws one, `results/NAME.png`. A long study keeps parts in `--work` and goes on where it was
stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tests.studies.figures import differences, documents, rewritten
from tests.studies.parts import Ended, command, command_at
from tests.studies.registry import STUDIES
from tests.studies.study import DATA, OUT, Study

ROOT = Path(__file__).parents[2]
RESULTS = Path(__file__).parent / "results"
WORKERS = ("jobs", "backend", "address")


def code_of(study: Study) -> str:
    """The last commit that changed the library or the study."""
    paths = ["datasets", "twin", "fusion", "tests/studies", ":!tests/studies/results"]
    done = subprocess.run(
        ["git", "log", "-1", "--format=%h", "--", *paths], cwd=ROOT, capture_output=True, text=True
    )
    return done.stdout.strip() or "unknown"


def executed(study: Study, words: Sequence[str], workers: dict[str, str]) -> Ended:
    """Run the study's command: its trials where the workers are, or all of it where it has no trials."""
    if study.spread:
        return command([*words, *(word for name, value in workers.items() for word in (f"--{name}", value))])
    if workers.get("backend") == "dask":
        return command_at(workers.get("address"), words)
    return command(words)


def run(study: Study, work: Path, again: bool, workers: dict[str, str] | None = None) -> bool:
    """Run one study and keep its result; False where it failed."""
    file = RESULTS / f"{study.name}.json"
    if file.is_file() and not again and json.loads(file.read_text())["commit"] == code_of(study):
        print(f"{study.name}: has a result of this code")
        return True
    data = os.environ.get("TERRAFUSION_DATA", "")
    if study.needs_logs() and not data:
        print(f"{study.name}: needs field logs; set TERRAFUSION_DATA", file=sys.stderr)
        return False
    out = work / study.name
    out.mkdir(parents=True, exist_ok=True)
    words = [word.replace(OUT, str(out)).replace(DATA, data) for word in study.command]
    if words[0] == "terrafusion":
        words[0:1] = ["-c", "from terrafusion.fusion.cli.main import main; main()"]
    print(f"{study.name}: about {study.minutes:g} min ...", flush=True)
    begun = time.monotonic()
    done = executed(study, words, workers or {})
    if done.returncode != 0:
        print(f"{study.name}: {(done.stderr or done.stdout).strip().splitlines()[-1]}", file=sys.stderr)
        return False
    keep(study, done.stdout, time.monotonic() - begun, out)
    return True


def keep(study: Study, printed: str, seconds: float, out: Path) -> None:
    """Write the result: figures, table and picture."""
    printed = printed.replace(str(out), "OUT").replace(os.environ.get("TERRAFUSION_DATA") or "\0", "DATA")
    figures = {name: found for name, pattern in study.figures.items() if (found := first(pattern, printed))}
    missing = sorted(set(study.figures) - set(figures))
    if missing:
        raise SystemExit(f"{study.name}: no figure {', '.join(missing)} in what it printed")
    command = study.command if study.command[0] == "terrafusion" else ("python", *study.command)
    file = RESULTS / f"{study.name}.json"
    before = json.loads(file.read_text(encoding="utf-8"))["figures"] if file.is_file() else {}
    if lost := sorted(set(before) - set(figures)):
        raise SystemExit(f"{study.name}: no pattern of the registry gives {', '.join(lost)}; add one first")
    result = {
        "study": study.name,
        "question": study.question,
        "command": " ".join(command).replace(OUT, "OUT").replace(DATA, "DATA"),
        "commit": code_of(study),
        "minutes": round(seconds / 60.0, 1),
        "figures": figures,
    }
    RESULTS.mkdir(exist_ok=True)
    file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    text = f"# {study.question}\n\n`{result['command']}`\n\n```text\n{printed.rstrip()}\n```\n"
    (RESULTS / f"{study.name}.md").write_text(text, encoding="utf-8")
    if study.picture and (out / study.picture).is_file():
        shutil.copyfile(out / study.picture, RESULTS / f"{study.name}.png")


def first(pattern: str, text: str) -> str | None:
    """The group of the first line that begins as the pattern says."""
    found = re.search(rf"^{pattern}", text, re.MULTILINE)
    return found[1] if found else None


def show() -> None:
    """One line a study: whether it has a result, how long it takes, what it asks."""
    for study in STUDIES:
        file = RESULTS / f"{study.name}.json"
        state = json.loads(file.read_text())["commit"] if file.is_file() else "not run"
        print(f"{study.name:18s} {state:9s} {study.minutes:5g} min  {study.question}")


def check(write: bool) -> int:
    """Hold the documents against the results; with `write`, put the results into them."""
    wrong = 0
    for path in documents(ROOT):
        text = path.read_text(encoding="utf-8")
        if write:
            path.write_text(rewritten(text, RESULTS), encoding="utf-8")
            continue
        for line in differences(text, RESULTS):
            print(f"{path.relative_to(ROOT)}: {line}")
            wrong += 1
    return int(wrong > 0)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("list")
    running = verbs.add_parser("run")
    running.add_argument("names", nargs="*", metavar="NAME", help="see `list`")
    running.add_argument("--all", action="store_true", help="every study, the quickest first")
    running.add_argument("--again", action="store_true", help="also what has a result of this code")
    running.add_argument("--work", type=Path, default=ROOT / "studies-work", help="folder for parts")
    for name in WORKERS:
        running.add_argument(f"--{name}", help="where to run, see `terrafusion sweep --help`")
    verbs.add_parser("figures").add_argument("--write", action="store_true")
    given = parser.parse_args()
    if given.verb == "list":
        show()
        return 0
    if given.verb == "figures":
        return check(given.write)
    known = {study.name: study for study in STUDIES}
    if unknown := set(given.names) - set(known):
        parser.error(f"no study '{min(unknown)}'; see `list`")
    chosen = sorted(STUDIES, key=lambda s: s.minutes) if given.all else [known[n] for n in given.names]
    if not chosen:
        parser.error("name a study, or give --all")
    workers = {name: value for name in WORKERS if (value := getattr(given, name))}
    failed = [s.name for s in chosen if not run(s, given.work.absolute(), given.again, workers)]
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
