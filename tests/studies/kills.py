"""Commands that are killed, interrupted or run on a troubled machine: is a half file taken for whole?

    python -m tests.studies.kills --kills 50 --out OUT

Each long command runs in a child process and is ended by SIGKILL, every fifth time by SIGINT, half of them
before one of its file operations, half after some of its computing time, drawn at random with a seed. Every
file it left must then be whole or bear the name of a part, a log folder must be refused or be the whole log.
After every few kills the same command must end well, with the files of an undisturbed run and nothing else.
Then each command meets a machine in trouble: it works, or says so in one line and leaves nothing half done.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import importlib
import json
import os
import resource
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.scratch import PREFIX
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.datasets.readers import open_recording
from tests.datasets.fuzz import cpu_s

SCENARIO = """\
description: a short drive with turns both ways
drive:
  - {duration_s: 2}
  - {duration_s: 6, v_mps: 0.9}
  - {duration_s: 7, v_mps: 0.9, yaw_rate_radps: 0.4}
  - {duration_s: 7, v_mps: 0.9, yaw_rate_radps: -0.4}
max_accel_mps2: 0.5
route:
  - {terrain: asphalt}
"""
SWEEP = """\
description: slopes
scenario: drive.yaml
axes:
  terrain: [asphalt, loose_sand]
  slope_deg: [0, 5, 10, 15]
"""
COMMANDS: dict[str, tuple[str, ...]] = {
    "simulate": ("simulate", "drive.yaml", "--out", "out/run"),
    "simulate to mcap": ("simulate", "drive.yaml", "--out", "out/run.mcap", "--force"),
    "convert": ("convert", "log", "out/log", "--force"),
    "replay": ("replay", "log", "--mode", "fixed", "--out", "out/run"),
    "sweep": ("sweep", "slopes.yaml", "--out", "out/run", "--jobs", "1", "--recordings", "3"),
    "calibrate --sensors": ("calibrate", "log", "--sensors", "--out", "out/robot.yaml"),
    "calibrate": (
        "calibrate", "log", "--terrain", "asphalt", "--parameters", "soil.shear.friction_cap", "--out",
        "out/run",
    ),
    "gap": ("gap", "log", "--effects", "wheel_radius,gyro_bias", "--out", "out/run"),
    "benchmark": ("benchmark", "--only", "firm=1", "--jobs", "1", "--out", "out/run"),
    "terrain train": ("terrain", "train", "--seeds", "1", "--jobs", "1", "--out", "out/model.yaml"),
}  # fmt: skip
"""Every command that runs for long, with little to do."""
RERUN_EVERY, INTERRUPT_EVERY = 5, 5
LONGEST_S = 900.0
"""Time after which a command hangs, on a busy machine."""
NOT_TRIED = 72
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
FILE_EVENTS = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.chmod", "shutil.rmtree")


@dataclass(frozen=True)
class End:
    """How a command ended: exit status (negative: the signal), what it wrote to stderr, what it took."""

    status: int
    err: str
    events: int
    cpu_s: float

    def refused_in_one_line(self) -> bool:
        """Whether it ended with a known error."""
        lines = self.err.strip().splitlines()
        return self.status == 1 and "Traceback" not in self.err and lines[-1:] == [lines[-1]] and (
            lines[-1].startswith("error: ")
        )  # fmt: skip


def started(
    words: tuple[str, ...], work: Path, kill_event: int = 0, sign: int = signal.SIGKILL,
    trouble: Callable[[], None] | None = None,
) -> int:  # fmt: skip
    """A child that runs a command in `work`; before its file operation `kill_event` it gets `sign`."""
    child = os.fork()
    if child:
        return child
    status = 70
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        (work / "tmp").mkdir(exist_ok=True)
        os.chdir(work)
        os.environ["TMPDIR"] = str(work / "tmp")
        importlib.import_module("tempfile").tempdir = None
        streams = [
            os.open(f"{name}.txt", os.O_CREAT | os.O_TRUNC | os.O_WRONLY) for name in ("stdout", "stderr")
        ]
        for own, stream in zip(streams, (1, 2), strict=True):
            os.dup2(own, stream)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        seen = watched(kill_event, sign)
        if trouble is not None:
            trouble()
        status = _main(words)
    except NotTried:
        status = NOT_TRIED
    else:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        with contextlib.suppress(OSError):
            Path("events.txt").write_text(str(seen[0]))
    finally:
        os._exit(status)


def _main(words: tuple[str, ...]) -> int:
    import traceback

    from terrafusion.fusion.cli.main import main

    sys.argv = ["terrafusion", *words]
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    except BaseException:
        traceback.print_exc()
        return 71
    return 0


def watched(kill_event: int, sign: int = signal.SIGKILL) -> list[int]:
    """Counts file operations, and ends the process before one of them."""
    seen, own = [0], os.getpid()

    def hook(event: str, args: tuple[object, ...]) -> None:
        if os.getpid() != own:
            return
        if event in FILE_EVENTS or (event == "open" and isinstance(args[2], int) and args[2] & WRITES):
            seen[0] += 1
            if seen[0] == kill_event:
                os.kill(own, sign)

    sys.addaudithook(hook)
    return seen


def ended(child: int, work: Path, kill_cpu_s: float = 0.0, sign: int = signal.SIGKILL) -> End:
    """Waits for a child; after `kill_cpu_s` of computing it gets `sign`."""
    deadline = time.monotonic() + LONGEST_S
    while True:
        done, status, used = os.wait4(child, os.WNOHANG)
        if done:
            break
        if kill_cpu_s and cpu_s(child) >= kill_cpu_s:
            os.kill(child, sign)
            kill_cpu_s = 0.0
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            _, status, used = os.wait4(child, 0)
            break
        time.sleep(0.005)
    err, count = work / "stderr.txt", work / "events.txt"
    events = int(count.read_text()) if count.is_file() else 0
    count.unlink(missing_ok=True)
    code = os.waitstatus_to_exitcode(status)
    said = err.read_text(errors="replace") if err.is_file() else ""
    return End(code, said, events, used.ru_utime + used.ru_stime)


# --- what is left ----------------------------------------------------------------------------------------


def is_part(path: Path) -> bool:
    """Whether a name says that its content is work in progress."""
    return any(
        name.startswith(PREFIX) or name.endswith((".part", ".parts")) or name == "parts"
        for name in path.parts
    )


def whole(path: Path) -> bool:
    """Whether a file is complete, by its format."""
    data, kind = path.read_bytes(), path.suffix
    if not data:
        return kind == ".jsonl"
    try:
        if path.name.endswith(".csv.gz"):
            data, kind = gzip.decompress(data), ".csv"
        if kind == ".json":
            json.loads(data)
        elif kind == ".jsonl":
            [json.loads(line) for line in data.splitlines()]
        elif kind == ".yaml":
            read_yaml(path)
    except (EOFError, OSError, ValueError, TerrafusionError):
        return False
    tails = {".html": b"</html>", ".png": b"IEND\xaeB`\x82", ".parquet": b"PAR1", ".mcap": b"\x89MCAP0\r\n"}
    if kind == ".csv":
        rows = data.split(b"\n")
        return (
            rows[-1] == b"" and len({row.count(b",") for row in rows[:-1] if not row.startswith(b"#")}) == 1
        )
    return data.rstrip(b"\n" if kind == ".html" else b"").endswith(tails.get(kind, b""))


def rows_of(log: Path) -> dict[str, int]:
    """Number of samples of each channel of a log.

    Raises:
        TerrafusionError: it is no log.
    """
    return {name: len(channel) for name, channel in open_recording(str(log)).channels().items()}


def half_files(out: Path, reference: Path) -> list[str]:
    """Files of `out` that pass for whole and are not; logs that open and lack samples."""
    bad = [
        str(path.relative_to(out))
        for path in sorted(out.rglob("*"))
        if path.is_file() and not is_part(path.relative_to(out)) and not whole(path)
    ]
    for meta in sorted(out.rglob("meta.yaml")):
        folder = meta.parent.relative_to(out)
        if not is_part(folder):
            with contextlib.suppress(TerrafusionError):
                if rows_of(out / folder) != rows_of(reference / folder):
                    bad.append(f"{folder}: not the whole log")
    return bad


def names_in(folder: Path) -> set[str]:
    """All files below a folder."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


# --- kills -----------------------------------------------------------------------------------------------


def prepared(work: Path) -> Path:
    """A folder with what the commands read."""
    from terrafusion.datasets.writers import write_log_folder
    from terrafusion.twin.simulate import simulate

    work.mkdir(parents=True, exist_ok=True)
    (work / "drive.yaml").write_text(SCENARIO)
    (work / "slopes.yaml").write_text(SWEEP)
    if not (work / "log").exists():
        write_log_folder(simulate(str(work / "drive.yaml"), seed=1), work / "log")
    return work


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


# --- a machine in trouble --------------------------------------------------------------------------------


def full_disk() -> None:
    """No file may grow beyond 8 kB."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, resource.RLIM_INFINITY))


def read_only() -> None:
    """The folder for results may not be written; what is written as root is not tried."""
    Path("out").chmod(0o500)
    if os.getuid() == 0:
        raise NotTried


class NotTried(Exception):  # noqa: N818
    """A trouble that cannot be made here."""


def no_home() -> None:
    """Neither a home folder nor an entry for the user."""
    import pwd

    for name in ("HOME", "USER", "LOGNAME", "XDG_CACHE_HOME", "TERRAFUSION_CACHE"):
        os.environ.pop(name, None)

    def unknown(_: int) -> pwd.struct_passwd:
        raise KeyError("no such user")

    pwd.getpwuid = unknown


def no_compiler() -> None:
    """An empty cache and no compiler."""
    os.environ["TERRAFUSION_CACHE"] = str(Path("tmp/cache").absolute())
    os.environ["PATH"] = "/nowhere"
    os.environ.pop("CC", None)
    _forget_libraries()


def damaged_cache() -> None:
    """Every file of the cache of compiled code is cut in half."""
    cache = Path("cache").absolute()
    os.environ["TERRAFUSION_CACHE"] = str(cache)
    for path in cache.rglob("*"):
        if path.is_file():
            os.truncate(path, path.stat().st_size // 2)
    _forget_libraries()


def clock_set_back() -> None:
    """The clock of the machine goes back by ten years, once."""
    real, real_ns = time.time, time.time_ns
    time.time = lambda: real() - 3.15e8
    time.time_ns = lambda: real_ns() - 315_000_000_000_000_000


def _forget_libraries() -> None:
    """As a new process would be: no compiled code in memory."""
    for name, module in list(sys.modules.items()):
        if name.startswith("terrafusion.twin.engine"):
            for value in vars(module).values():
                if callable(getattr(value, "cache_clear", None)):
                    value.cache_clear()


TROUBLES: dict[str, Callable[[], None]] = {
    one.__name__.replace("_", " "): one
    for one in (full_disk, read_only, no_home, no_compiler, damaged_cache, clock_set_back)
}


def troubled(name: str, work: Path, trouble: Callable[[], None]) -> str:
    """ "works", "refused" in one line, or what is wrong."""
    out = work / "out"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    end = ended(started(COMMANDS[name], work, trouble=trouble), work)
    out.chmod(0o700)
    if end.status == NOT_TRIED:
        return "not tried"
    if end.status and not end.refused_in_one_line():
        return f"odd end {end.status}: {end.err.strip()[-200:]}"
    if bad := half_files(out, work / "reference"):
        return f"half file {bad[0]}"
    if end.status == 0 and names_in(out) != names_in(work / "reference"):
        return "other files"
    return "refused" if end.status else "works"


TWO = "two at once"


def two_at_once(name: str, work: Path) -> str:
    """Both end, and what is there is whole."""
    out = work / "out"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    ends = [ended(child, work) for child in [started(COMMANDS[name], work) for _ in range(2)]]
    if any("Traceback" in end.err or end.status not in (0, 1) for end in ends):
        return f"odd end: {[end.status for end in ends]} {ends[-1].err.strip()[-200:]}"
    if bad := half_files(out, work / "reference"):
        return f"half file {bad[0]}"
    return "works" if any(end.status == 0 for end in ends) else "both refused"


# --- the run ---------------------------------------------------------------------------------------------

HEAVY = ("gtsam", "pandas", "matplotlib.pyplot", "scipy.optimize", "pyarrow.parquet", "jinja2", "joblib")


def preload() -> None:
    """What commands import, so that children start with it."""
    for name in HEAVY:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    for part in ("fusion.replay", "fusion.cli.main", "twin.simulate", "datasets.writers"):
        importlib.import_module(f"terrafusion.{part}")


def main() -> None:
    """Print the table of kills and that of troubles."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--commands", nargs="*", default=list(COMMANDS))
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    preload()
    work, kept = prepared(given.out.absolute() / "work"), given.out / "rows.json"
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
