"""A machine in trouble: full disk, read-only folder, no home, no compiler, a clock set back, two at once."""

from __future__ import annotations

import ctypes
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tests.studies.kills.child import NOT_TRIED, NotTried, ended, started
from tests.studies.kills.commands import COMMANDS
from tests.studies.kills.leftovers import half_files, names_in


def full_disk() -> None:
    """No file may grow beyond 8 kB."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, resource.RLIM_INFINITY))


def read_only() -> None:
    """The folder for results may not be written, not by root either."""
    Path("out").chmod(0o500)
    obey_permissions()


def obey_permissions() -> None:
    """Let permission bits bind this process, though it be root's: give up the rights to pass them over.

    Raises:
        NotTried: the system refuses.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(CAPABILITY_VERSION, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable of capabilities below 32, and above
    if libc.capget(header, sets):
        raise NotTried
    for i in range(3):
        sets[i] &= ~(1 << CAP_DAC_OVERRIDE | 1 << CAP_DAC_READ_SEARCH)
    if libc.capset(header, sets):
        raise NotTried


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


CAPABILITY_VERSION, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 0x20080522, 1, 2
"""Of linux/capability.h."""
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
