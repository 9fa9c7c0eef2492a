"""Fuzzing of all readers and of the log checks: mutated files may be refused, nothing else.

    python tests/datasets/fuzz.py --count 2000 --seed 0

Each input is opened, examined, treated and summed up in a child process of its own, with an alarm
and a limit on its memory. An outcome is "read" or "refused" (a TerrafusionError of one line);
"crash", "hang" and "memory" are defects, and the input is kept for a look.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

HANG_S = 10
MEMORY_BYTES = 1 << 30
OUTCOMES = {0: "read", 1: "refused", 2: "crash", 3: "memory"}
DEFECTS = ("crash", "hang", "memory")

Bytes = Callable[[np.random.Generator, bytes], bytes]


# --- mutations -------------------------------------------------------------------------------------------


def truncate(rng: np.random.Generator, data: bytes) -> bytes:
    return data[: int(rng.integers(0, len(data)))]


def flip_bits(rng: np.random.Generator, data: bytes) -> bytes:
    out = bytearray(data)
    for at in rng.integers(0, len(out), size=int(rng.integers(1, 20))):
        out[at] ^= 1 << int(rng.integers(0, 8))
    return bytes(out)


def flip_head(rng: np.random.Generator, data: bytes) -> bytes:
    """Bits of the first kilobyte, where formats keep their structure."""
    return flip_bits(rng, data[:1024]) + data[1024:]


def huge_length(rng: np.random.Generator, data: bytes) -> bytes:
    """Four or eight bytes of a number that is no length of anything here."""
    word = rng.choice(
        np.array([b"\xff\xff\xff\x7f", b"\xff" * 8, b"\0\0\0\x40", b"\xff\xff\xff\xff"], dtype=object)
    )
    at = int(rng.integers(0, max(len(data) - 8, 1)))
    return data[:at] + word + data[at + len(word) :]


def cut_out(rng: np.random.Generator, data: bytes) -> bytes:
    a, b = sorted(rng.integers(0, len(data), size=2))
    return data[:a] + data[b:]


def repeat(rng: np.random.Generator, data: bytes) -> bytes:
    a, b = sorted(rng.integers(0, len(data), size=2))
    return data[:b] + data[a:]


def zero_range(rng: np.random.Generator, data: bytes) -> bytes:
    a = int(rng.integers(0, len(data)))
    b = min(len(data), a + int(rng.integers(1, 4096)))
    return data[:a] + bytes(b - a) + data[b:]


def noise(rng: np.random.Generator, data: bytes) -> bytes:
    """The first bytes, then nothing but noise."""
    return data[: int(rng.integers(0, 64))] + rng.bytes(int(rng.integers(1, 20_000)))


ODD_WORDS = (
    b"nan", b"inf", b"-1", b"1e308", b"1e999", b"", b"0", b"-0.0", b"9" * 400, b"0x10", b"1_0", b"null",
    b"\xff",    b'"', b"1,5", b"99999999999999999999", b"1e-320", b"-9223372036854775808", b"TRUE", b"\0",
)  # fmt: skip


def odd_words(rng: np.random.Generator, data: bytes) -> bytes:
    """Some numbers of a text replaced."""
    lines = data.split(b"\n")
    for _ in range(int(rng.integers(1, 6))):
        at = int(rng.integers(0, len(lines)))
        for mark in (b",", b"\t", b" ", b":"):
            if mark in lines[at]:
                words = lines[at].split(mark)
                words[int(rng.integers(0, len(words)))] = ODD_WORDS[int(rng.integers(0, len(ODD_WORDS)))]
                lines[at] = mark.join(words)
                break
    return b"\n".join(lines)


def shuffle_lines(rng: np.random.Generator, data: bytes) -> bytes:
    lines = data.split(b"\n")
    a, b = sorted(rng.integers(0, len(lines), size=2))
    part = lines[a:b]
    rng.shuffle(part)
    return b"\n".join([*lines[:a], *part, *lines[b:]])


def drop_column(rng: np.random.Generator, data: bytes) -> bytes:
    lines = data.split(b"\n")
    for mark in (b",", b"\t", b" "):
        if mark in lines[0]:
            k = int(rng.integers(0, lines[0].count(mark) + 1))
            kept = [mark.join(w for i, w in enumerate(line.split(mark)) if i != k) for line in lines]
            return b"\n".join(kept)
    return truncate(rng, data)


BINARY: tuple[Bytes, ...] = (truncate, flip_bits, flip_head, huge_length, cut_out, repeat, zero_range, noise)
TEXT: tuple[Bytes, ...] = (*BINARY, odd_words, odd_words, shuffle_lines, drop_column)


# --- the run ---------------------------------------------------------------------------------------------


def is_text(data: bytes) -> bool:
    return b"\0" not in data[:4096] and data[:4096].isascii()


def mutated(rng: np.random.Generator, sample: Path, folder: Path) -> Path:
    """A copy of the sample in `folder` with one of its files mutated; returns what is to be opened."""
    target = folder / sample.name
    shutil.copytree(sample, target)
    files = sorted(path for path in target.rglob("*") if path.is_file() and path.name != ".open")
    victim = files[int(rng.integers(0, len(files)))]
    data = victim.read_bytes()
    kinds = TEXT if is_text(data) else BINARY
    for _ in range(1 if rng.random() < 0.7 else 2):
        if data:
            data = kinds[int(rng.integers(0, len(kinds)))](rng, data)
    victim.write_bytes(data)
    return target / (target / ".open").read_text()


def open_and_examine(path: Path, repair_clock: bool) -> None:
    """What `inspect` and `convert --apply-fixes` do with a log; a pickle's hash counts as known."""
    from terrafusion.datasets.checks import repair, run_checks
    from terrafusion.datasets.core.conventions import Conventions, apply
    from terrafusion.datasets.readers.formats import Request, format_of
    from terrafusion.datasets.readers.sets.single_wheel import read_wheel_trials

    form = format_of(path)
    if form.name == "single_wheel_mat":  # trials, not a drive
        read_wheel_trials(path).summary()
        return
    request = Request(path, repair_clock=repair_clock, trusted=True)
    for recording in list(form.read(request))[:20]:
        recording = apply(recording, Conventions())
        run_checks(recording)
        repair(recording)


def outcome_in_child(work: Callable[[], int], seconds: float, outcomes: dict[int, str]) -> str:
    """The outcome of `work`, which returns an exit status, in a child that has so many seconds."""
    child = os.fork()
    if child == 0:
        os._exit(work())
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return outcomes.get(os.waitstatus_to_exitcode(status), "crash")
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "hang"


def outcome_of(path: Path, repair_clock: bool) -> str:
    """Open `path` in a child, limited in time and memory."""
    return outcome_in_child(lambda: _in_child(path, repair_clock), HANG_S, OUTCOMES)


def _in_child(path: Path, repair_clock: bool) -> int:
    limit_memory()
    return examined(path, repair_clock)


def cpu_s(process: int) -> float:
    """Processor time of a running process, s; 0 where it has gone."""
    try:
        ticks = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
    except (OSError, IndexError):
        return 0.0
    return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


def limit_memory() -> None:
    """Allow this process 1 GB more than it has now."""
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY_BYTES, resource.RLIM_INFINITY))


def examined(path: Path, repair_clock: bool) -> int:
    """Exit status of a look at an input: a key of `OUTCOMES`."""
    import warnings

    from terrafusion.datasets.core.errors import ConfigError, TerrafusionError

    warnings.simplefilter("error")
    try:
        open_and_examine(path, repair_clock)
    except TerrafusionError as error:
        lines = str(error).split("\n")  # a parameter file has one line a problem
        if (len(lines) > 1 and not isinstance(error, ConfigError)) or max(map(len, lines)) > 1500:
            print(f"{path}: not one short line: {error}", file=sys.stderr)
            return 2
        return 1
    except MemoryError:
        traceback.print_exc()
        return 3
    except BaseException:
        traceback.print_exc()
        return 2
    return 0


def run(count: int, seed: int, samples: list[Path], scratch: Path) -> Iterator[tuple[Path, str, float]]:
    """(input, outcome, seconds) of `count` mutated inputs, the samples in turn."""
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        folder = Path(tempfile.mkdtemp(dir=scratch, prefix=f"{i:05d}-"))
        path = mutated(rng, samples[i % len(samples)], folder)
        begun = time.monotonic()
        outcome = outcome_of(path, repair_clock=bool(rng.random() < 0.5))
        yield path, outcome, time.monotonic() - begun
        if outcome not in DEFECTS:
            shutil.rmtree(folder)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="samples whose name contains this")
    options = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parent))
    from fuzz_samples import write_samples

    scratch = Path(tempfile.mkdtemp(prefix="fuzz-"))
    samples = [path for path in write_samples(scratch / "samples") if options.only in path.name]
    for sample in samples:  # in this process, so that every child starts with the parsers in memory
        open_and_examine(sample / (sample / ".open").read_text(), repair_clock=False)
    counts: Counter[tuple[str, str]] = Counter()
    slowest = 0.0
    for path, outcome, seconds in run(options.count, options.seed, samples, scratch):
        counts[path.relative_to(scratch).parts[1], outcome] += 1
        slowest = max(slowest, seconds)
        if outcome in DEFECTS:
            print(f"{outcome}: {path}")
    for name in sorted({name for name, _ in counts}):
        told = ", ".join(f"{outcome} {counts[name, outcome]}" for outcome in (*OUTCOMES.values(), "hang"))
        print(f"{name:16} {told}")
    defects = sum(n for (_, outcome), n in counts.items() if outcome in DEFECTS)
    read = sum(n for (_, outcome), n in counts.items() if outcome == "read")
    print(f"{options.count} inputs, {read} read, {defects} defects, slowest {slowest:.2f} s")
    if not defects:
        shutil.rmtree(scratch)
    return int(defects > 0)


if __name__ == "__main__":
    sys.exit(main())
