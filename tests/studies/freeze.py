"""Freeze what `terrafusion` computes, and tell later what has changed.

    python tests/studies/freeze.py record --store DIR     # before a refactoring, with the old code installed
    python tests/studies/freeze.py check --store DIR      # after it, with the new code installed

Modules may move and get other names; commands, options and files may not. So this runs the `terrafusion`
script that stands beside the Python it is started with, and looks at nothing but what that leaves behind: it
imports nothing of the package, and needs no change when the package changes.

A case is a few commands with one folder for their results. Kept of each case: exit statuses, the names of
all files, the SHA-256 and a gzip copy of every machine-readable one, of standard output and of standard
error, and the seconds it took. Pages and images are only noted as there. All cases run in one folder for
scratch, with relative paths, one BLAS thread each and a fixed width of the terminal. Logs that other cases
read are made anew by `simulate`, so a twin that changed shows behind it, too: look at `log/...` first.

JSON is hashed with sorted keys and without what differs from run to run of the same code:

    realtime_factor, update_latency_ms    metrics.json of a replay: wall clock
    rows[].seconds                        benchmark.json: wall clock
    origin.commit, origin.sources         benchmark.json: hash of the checkout and of the source files

In printed text "24 x real time", a closing "(12.3 s)" and the date and time in the name of an output folder
are blanked; so are the paths of scratch and data.
A benchmark's folder `parts` is left out: it is only there to resume.

Exit status of `check`: 0 all the same, 1 something differs or is not in the store.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

HASHED = {".json", ".jsonl", ".csv", ".tum", ".yaml", ".md", ".txt", ".mcap", ".parquet"}
VOLATILE = {"realtime_factor", "update_latency_ms", "rows[].seconds", "origin.commit", "origin.sources"}
VOLATILE_TEXT = (
    (r"\d+(\.\d+)? x real time", "_ x real time"),
    (r"\(\d+\.\d s\)$", "(_ s)"),
    (r"-\d{8}-\d{6}\b", "-DATE-TIME"),
)
LIMIT_S = 1200.0
ENVIRONMENT = {
    "COLUMNS": "120", "NO_COLOR": "1", "TERM": "dumb",
    "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1",
}  # fmt: skip

INPUTS = {
    "short.yaml": """\
description: a short drive with turns both ways
drive:
  - {duration_s: 2}
  - {duration_s: 8, v_mps: 0.9}
  - {duration_s: 8, v_mps: 0.9, yaw_rate_radps: 0.4}
  - {duration_s: 8, v_mps: 0.9, yaw_rate_radps: -0.4}
max_accel_mps2: 0.5
route:
  - {terrain: asphalt}
""",
    "sweep.yaml": """\
description: a small sweep
scenario: short.yaml
axes:
  terrain: [asphalt, loose_sand]
  slope_deg: [0, 10]
  seed: [1, 2]
""",
}

FIELD = {  # log and the outage of its GNSS; umich and norlab have none, which is a case, too
    "husky": ("husky_parkinglot/test1", "150:60"),
    "s5t1": ("wvu_pathfinder/s5t1", "60:30"),
    "t17": ("wvu_pathfinder/test17run", "25:15"),
    "umich": ("umich_husky/mair_mocap/trial1", "20:10"),
    "grass": ("norlab_drive/grass_2024_8_8_16h11s19/raw", "60:20"),
    "asphalt": ("norlab_drive/asphalt_2024_9_25_12h8s57/raw", "60:20"),
}
TWIN = {
    "demo": ("demo", "60:20"),
    "eight": ("figure_eight --terrain loose_sand --slope-deg 5 --seed 3", "40:20"),
    "mixed": ("mixed_terrain --seed 4", "100:30"),
}
SIMULATIONS = {
    "spin_bag": "spin --vehicle husky --out {out}/log.mcap",
    "tilted": "straight --cross-slope-deg 10 --payload-kg 30 --payload-at 0,0.1,0.4 --out {out}/log",
    "paper": "paper_profile --terrain loose_sand --slope-deg 5 --vehicle warthog --out {out}/log",
    "worn": "circle --effect wheel_radius/scale=0.03 --effect gyro_bias/constant=0.01 --out {out}/log",
    "steps": "staircase --terrain mud --slope-deg 3 --payload-kg 10 --out {out}/log",
    "points": "waypoints --terrain grass --vehicle pathfinder --seed 6 --out {out}/log",
    "chirp": "chirp --terrain gravel --noiseless --out {out}/log",
    "spin_snow": "spin --terrain snow --vehicle generic --seed 7 --out {out}/log",
}
OTHER_LOGS = (
    "husky_parkinglot/test2", "borealtc/ASPHALT/00", "borealtc/ICE/05",
    "borealtc/FLOORING/00", "borealtc/SANDY_LOAM/06", "borealtc/SNOW/08", "umich_husky/mair_mocap/trial7",
    "umich_husky/mair_mocap/trial2", "umich_husky/mair_mocap/trial3", "umich_husky/field/slip_detect1",
    "umich_husky/field/slip_detect2", "umich_husky/field/up_to_hill1", "umich_husky/field/sand_small_pebble",
    "umich_husky/field/mars_sand2_no_disturbance", "norlab_drive/grass_2024_8_8_15h56s39/raw",
    "norlab_drive/sand_2024_9_25_14h13s47/windows", "norlab_drive/gravel_2024_8_6_11h37s32/windows",
    "norlab_drive/ice_2024_7_30_16h30s21/windows#7", "norlab_drive/grass_2024_7_29_14h46s15/raw",
)  # fmt: skip
REFUSED = (
    "replay no_such_log --out {out}/r", "replay {log} --mode odd --out {out}/r", "inspect short.yaml",
    "replay {log} --gnss-outage 10 --out {out}/r", "gap {log} --effects odd --out {out}/g", "inspect",
    "calibrate {log} --parameters soil.odd --out {out}/c", "convert {log} {out}/x.bag", "simulate spin",
    "simulate spin --slope-deg 40 --out {out}/l", "simulate nowhere --out {out}/l",
    "benchmark --only odd --out {out}/b", "odd",
)  # fmt: skip
COMMANDS = (
    "", "demo", "inspect", "fetch", "convert", "simulate", "sweep", "benchmark", "calibrate", "gap",
    "gap-blind", "replay", "terrain train", "terrain eval", "policy fit",
)  # fmt: skip
QUICK = {
    "log/eight", "replay/eight-adaptive", "replay/eight-adaptive-batch", "replay/t17-adaptive",
    "replay/t17-robust-batch", "replay/umich-robust", "replay/umich-adaptive-batch", "gap/twin",
    "calibrate/sand", "convert/twin", "inspect/eight", "inspect/t17", "refused",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A few commands with one folder, `out`, for what they write; `{out}` in them stands for it."""

    name: str
    commands: tuple[str, ...]

    @property
    def out(self) -> str:
        return self.name.replace("/", "-")

    def argv(self) -> list[list[str]]:
        return [shlex.split(command.replace("{out}", self.out)) for command in self.commands]

    def reads(self, other: Case) -> bool:
        """Does it read what the other case writes?"""
        return other is not self and any(w.startswith(f"{other.out}/") for a in self.argv() for w in a)


def all_cases() -> list[Case]:
    """Long ones first, so that no processor idles at the end."""
    logs = [f"log-{name}/log" for name in TWIN]
    eight, short = "log-eight/log", "log-short-{}/log"
    references = " ".join(f"--reference {short.format(seed)}" for seed in range(1, 6))
    found = {f"log/{name}": [f"simulate {words} --out {{out}}/log"] for name, (words, _) in TWIN.items()}
    worn = {12: "--effect wheel_radius/scale=0.06"}
    for seed in (1, 2, 3, 4, 5, 11, 12):
        words = f"simulate short.yaml --seed {seed} {worn.get(seed, '')}"
        found[f"log/short-{seed}"] = [f"{words} --out {{out}}/log"]
    found["benchmark"] = ["benchmark --quick --only firm=1 --only outages=1 --jobs 1 --out {out}/b"]
    found["demo"] = ["demo --out {out}/d"]
    found["gap/null"] = [f"gap {short.format(11)} {references} --terrain asphalt --out {{out}}/g"]
    found["gap/effect"] = [
        f"gap {short.format(12)} {references} --terrain asphalt --out {{out}}/g"
        " --write-vehicle {out}/g/new.yaml"
    ]
    found["gap/twin"] = [f"gap {short.format(11)} --terrain asphalt --out {{out}}/g"]
    found["calibrate/asphalt"] = [
        f"calibrate {short.format(1)} --terrain asphalt --out {{out}}/c"
        " --parameters soil.shear.friction_cap,vehicle.wheel.radius_m"
    ]
    found["calibrate/sand"] = [
        f"calibrate {eight} --terrain loose_sand --slope-deg 5 --out {{out}}/c"
        " --parameters vehicle.wheel.radius_m,vehicle.body.mass_kg"
    ]
    found["replay/husky-calibrated"] = [
        "replay husky_parkinglot/test1 --gnss-outage 150:60 --batch --calibrate --mcap --out {out}/r"
    ]
    replays = FIELD | {name: (f"log-{name}/log", outage) for name, (_, outage) in TWIN.items()}
    for name, (log, outage) in replays.items():
        for mode in ("adaptive", "fixed", "robust", "innovation"):
            words = f"replay {log} --mode {mode} --gnss-outage {outage} --out {{out}}/r"
            found[f"replay/{name}-{mode}"] = [words]
            if mode in ("adaptive", "robust") or name in ("t17", "umich", "eight"):
                found[f"replay/{name}-{mode}-batch"] = [f"{words} --batch"]
    found |= {f"simulate/{name}": [f"simulate {words}"] for name, words in SIMULATIONS.items()}
    there_and_back = ["convert {} {{out}}/log.mcap", "convert {{out}}/log.mcap {{out}}/back"]
    found["convert/twin"] = [word.format(eight) for word in there_and_back]
    found["convert/pathfinder"] = [word.format("wvu_pathfinder/test17run") for word in there_and_back]
    found["convert/bag"] = ["convert husky_parkinglot/test1 {out}/log --vehicle husky --apply-fixes"]
    found["sweep"] = ["sweep sweep.yaml --out {out}/s --jobs 1 --recordings 3"]
    found |= {f"inspect/{name}": [f"inspect {log} --json"] for name, (log, _) in replays.items()}
    found["inspect/page"] = [f"inspect {log}" for log in (eight, "husky_parkinglot/test1")]
    found |= {f"inspect/{log.replace('/', '-')}": [f"inspect {log} --json"] for log in OTHER_LOGS}
    found["refused"] = [words.replace("{log}", logs[1]) for words in REFUSED]
    found["help"] = [f"{name} --help" for name in COMMANDS] + ["simulate spin --effect help --out {out}/l"]
    return [Case(name, tuple(commands)) for name, commands in found.items()]


def run(case: Case, work: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Run a case; what is kept of it, and its machine-readable files."""
    out = work / case.out
    out.mkdir()
    script = Path(sys.executable).with_name("terrafusion")
    exits, begun = [], time.monotonic()
    printed = {}
    for n, words in enumerate(case.argv()):
        done = subprocess.run(
            [script, *words], cwd=work, env=os.environ | ENVIRONMENT, capture_output=True, timeout=LIMIT_S,
            check=False,
        )  # fmt: skip
        exits.append(done.returncode)
        ending = "json" if "--json" in words and not done.returncode else "txt"
        printed[f"stdout-{n:02}.{ending}"], printed[f"stderr-{n:02}.txt"] = done.stdout, done.stderr
    seconds = round(time.monotonic() - begun, 2)
    paths = {path.relative_to(out).as_posix(): path for path in sorted(out.rglob("*")) if path.is_file()}
    paths = {name: path for name, path in paths.items() if "parts" not in path.relative_to(out).parts}
    raw = printed | {name: path.read_bytes() for name, path in paths.items() if path.suffix in HASHED}
    kept = {name: canonical(name, data, work) for name, data in raw.items()}
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in kept.items()}
    told = {"commands": case.commands, "exits": exits, "files": sorted(paths), "sha256": sums}
    return told | {"seconds": seconds}, kept


def canonical(name: str, data: bytes, work: Path) -> bytes:
    """The same bytes for the same result."""
    ending = Path(name).suffix
    if ending in (".mcap", ".parquet"):
        return data
    text = data.decode().replace(str(work), "WORK").replace(os.environ["TERRAFUSION_DATA"], "DATA")
    if ending == ".json" and text:
        return json.dumps(without(json.loads(text)), sort_keys=True, indent=0).encode()
    if ending == ".jsonl":
        return "\n".join(json.dumps(json.loads(x), sort_keys=True) for x in text.splitlines()).encode()
    if ending in (".txt", ".md"):
        for pattern, instead in VOLATILE_TEXT:
            text = re.sub(pattern, instead, text, flags=re.MULTILINE)
    return text.encode()


def without(value: Any, at: str = "") -> Any:
    """JSON without its volatile keys."""
    if isinstance(value, list):
        return [without(one, f"{at}[]") for one in value]
    if isinstance(value, dict):
        paths = {key: f"{at}.{key}".lstrip(".") for key in value}
        return {key: without(one, paths[key]) for key, one in value.items() if paths[key] not in VOLATILE}
    return value


def leaves(name: str, data: bytes) -> dict[str, Any] | None:
    """Single values by their place: of JSON and tables; None for anything else."""
    ending = Path(name).suffix
    if ending == ".json":
        return dict(flat(json.loads(data)))
    if ending == ".jsonl":
        return dict(flat([json.loads(line) for line in data.decode().splitlines()]))
    if ending == ".parquet":
        from pyarrow import parquet

        return dict(flat(parquet.read_table(io.BytesIO(data)).to_pydict()))
    if ending not in (".csv", ".tum"):
        return None
    rows = list(csv.reader(io.StringIO(data.decode()), delimiter=" " if ending == ".tum" else ","))
    head = rows.pop(0) if ending == ".csv" and rows else ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
    return {f"{key}[{n}]": cell for n, row in enumerate(rows) for key, cell in zip(head, row, strict=False)}


def flat(value: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in inside:
        yield from flat(one, f"{at}[{key}]" if isinstance(value, list) else f"{at}.{key}".lstrip("."))
    if not isinstance(value, (dict, list)):
        yield at, value


def number(value: Any) -> float | None:
    try:
        return None if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return None


def difference(name: str, old: bytes, new: bytes) -> str:
    """How two versions of a file differ, in a line."""
    before, after = leaves(name, old), leaves(name, new)
    if before is None or after is None:
        if Path(name).suffix == ".mcap":
            return f"{len(old)} -> {len(new)} bytes"
        lines = [f"{data.decode()}\n(end)\n".splitlines() for data in (old, new)]
        both = enumerate(zip(*lines, strict=False), 1)
        n, (a, b) = next(((n, pair) for n, pair in both if pair[0] != pair[1]), (0, ("", "")))
        return f"line {n}: {a.strip()[:120]!r} -> {b.strip()[:120]!r}"
    said, largest, words = [], {"relative": (0.0, ""), "absolute": (0.0, "")}, []
    for sign, keys in (("removed", before.keys() - after.keys()), ("added", after.keys() - before.keys())):
        if keys:
            said.append(f"{len(keys)} {sign}, e.g. {min(keys)}")
    changed = [key for key in before.keys() & after.keys() if before[key] != after[key]]
    for key in sorted(changed):
        a, b = number(before[key]), number(after[key])
        if a is None or b is None:
            words.append(f"{key} {str(before[key])[:60]!r} -> {str(after[key])[:60]!r}")
            continue
        absolute = abs(a - b)
        for kind, size in (("absolute", absolute), ("relative", absolute / (max(abs(a), abs(b)) or 1.0))):
            largest[kind] = max(largest[kind], (size, key))
    said += [f"{len(changed)} of {len(before)} values changed"] if changed else []
    said += [f"largest {kind} {size:.3g} at {key}" for kind, (size, key) in largest.items() if key]
    said += [f"{len(words)} not numbers, e.g. {words[0]}"] if words else []
    return "; ".join(said) or "same values, written differently"


Outcome = tuple[bool, float, float, list[str]]
"""Whether a case is well, its seconds before and now, and lines to print."""


def made(case: Case, work: Path, store: Path) -> Outcome:
    """Run a case only for those that read what it writes."""
    return True, 0.0, run(case, work)[0]["seconds"], []


def record(case: Case, work: Path, store: Path) -> Outcome:
    """Run and keep a case."""
    told, kept = run(case, work)
    folder = store / case.out
    shutil.rmtree(folder, ignore_errors=True)
    for name, data in kept.items():
        path = folder / f"{name}.gz"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(gzip.compress(data, mtime=0))
    (folder / "case.json").write_text(json.dumps(told, indent=1))  # last: a case with it is complete
    lines = [f"exit {told['exits']}"] if any(told["exits"]) else []
    return True, told["seconds"], told["seconds"], lines


def check(case: Case, work: Path, store: Path) -> Outcome:
    """Run a case and compare it with what is kept."""
    told, kept = run(case, work)
    before = stored(case, store)
    if before is None:
        return False, 0.0, told["seconds"], ["not in the store, or recorded with other commands"]
    lines = [f"exits: {before['exits']} -> {told['exits']}"] if before["exits"] != told["exits"] else []
    for word, one, other in (("missing", before, told), ("new", told, before)):
        if more := sorted(set(one["files"]) - set(other["files"])):
            lines.append(f"{word}: {', '.join(more)}")
    old, new = before["sha256"], told["sha256"]
    for name in sorted(old.keys() & new.keys()):
        if old[name] == new[name]:
            continue
        was = canonical(name, gzip.decompress((store / case.out / f"{name}.gz").read_bytes()), work)
        if was != kept[name]:  # else a key has been called volatile since
            lines.append(f"{name}: {difference(name, was, kept[name])}")
    return not lines, before["seconds"], told["seconds"], lines


def stored(case: Case, store: Path) -> dict[str, Any] | None:
    """What is kept of a case, if it is complete and has the same commands."""
    path = store / case.out / "case.json"
    told = json.loads(path.read_text()) if path.exists() else None
    return told if told and tuple(told["commands"]) == case.commands else None


def main() -> int:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("task", choices=("record", "check"))
    parser.add_argument("--store", type=Path, required=True, metavar="DIR", help="outside the repository")
    parser.add_argument("--quick", action="store_true", help="a subset that touches everything")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="cases at a time (2)")
    parser.add_argument("--only", default="*", metavar="GLOB", help="cases by name, e.g. 'replay/husky-*'")
    parser.add_argument("--again", action="store_true", help="record what is in the store, too")
    given = parser.parse_args()
    store = given.store.resolve()
    if store.is_relative_to(Path(__file__).resolve().parents[2]):
        parser.error("the store must lie outside the repository")
    if not os.environ.get("TERRAFUSION_DATA"):
        parser.error("set TERRAFUSION_DATA to the folder of the field logs")
    cases = all_cases()
    chosen = [c for c in cases if fnmatch(c.name, given.only) and (c.name in QUICK or not given.quick)]
    if given.task == "record" and not given.again:
        chosen = [case for case in chosen if stored(case, store) is None]
    first = [case for case in cases if any(one.reads(case) for one in chosen)]
    begun, failed, before_s, now_s = time.monotonic(), 0, 0.0, 0.0
    with tempfile.TemporaryDirectory(prefix="freeze-") as scratch, ThreadPoolExecutor(given.jobs) as pool:
        work = Path(scratch).resolve()
        for name, text in INPUTS.items():
            (work / name).write_text(text)
        for batch in (first, [case for case in chosen if case not in first]):
            futures = []
            for case in batch:
                task = (record if given.task == "record" else check) if case in chosen else made
                futures.append(pool.submit(task, case, work, store))
            for case, future in zip(batch, futures, strict=True):
                well, before, now, lines = future.result()
                if case not in chosen:
                    continue
                failed, before_s, now_s = failed + (not well), before_s + before, now_s + now
                word = "DIFFERENT" if not well else "recorded" if given.task == "record" else "same"
                told = [f"{case.name}: {word} ({before:.1f} -> {now:.1f} s)", *lines]
                print("\n    ".join(told), flush=True)
    wall = time.monotonic() - begun
    print(f"{len(chosen)} cases, {failed} different; {before_s:.0f} s before, {now_s:.0f} s now", end="; ")
    print(f"{wall:.0f} s by the clock")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
