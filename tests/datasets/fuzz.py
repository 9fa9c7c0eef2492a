"""Mutated files of all formats, and what a reader may do with them: read them, or refuse them in one line.

`python -m tests.studies.fuzz` tries them.
"""

from __future__ import annotations

import os
import resource
import shutil
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import numpy as np

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

MEMORY_BYTES = 1 << 30

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
    shutil.rmtree(target, ignore_errors=True)  # of the same case in a child that it ended
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
    """What `inspect` and `convert --apply-fixes` do with a log."""
    from terrafusion.datasets.checks import repair, run_checks
    from terrafusion.datasets.core.conventions import Conventions, apply
    from terrafusion.datasets.readers.formats import Request, format_of

    request = Request(path, repair_clock=repair_clock)
    for recording in list(format_of(path).read(request))[:20]:
        recording = apply(recording, Conventions())
        run_checks(recording)
        repair(recording)


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
