"""A command in a child process: started, ended by a signal, or on a troubled machine."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.datasets.fuzz import cpu_s

LONGEST_CPU_S, LONGEST_S = 300.0, 7200.0
"""Processor time, and time in all, after which a command hangs: a busy machine makes nothing slow."""
NOT_TRIED = 72
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
FILE_EVENTS = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.chmod", "shutil.rmtree")


class NotTried(Exception):  # noqa: N818
    """A trouble that cannot be made here."""


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
        if time.monotonic() > deadline or cpu_s(child) > LONGEST_CPU_S:
            os.kill(child, signal.SIGKILL)
            _, status, used = os.wait4(child, 0)
            break
        time.sleep(0.005)
    err, count = work / "stderr.txt", work / "events.txt"
    # Killed while it wrote the count, a child leaves an empty file.
    events = int(count.read_text() or 0) if count.is_file() else 0
    count.unlink(missing_ok=True)
    code = os.waitstatus_to_exitcode(status)
    said = err.read_text(errors="replace") if err.is_file() else ""
    return End(code, said, events, used.ru_utime + used.ru_stime)
