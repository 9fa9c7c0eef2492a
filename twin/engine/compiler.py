"""C source to shared library: compiled once, cached, found again.

Entries of the cache (`library_cache`) are named by a hash of source, flags, compiler and processor.
"""

import ctypes
import functools
import hashlib
import importlib.util
import logging
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from terrafusion.datasets.core.scratch import process_folder, scratch_folder
from terrafusion.twin.engine import library_cache
from terrafusion.twin.engine.library_cache import cache_folder, say

LOG = logging.getLogger("terrafusion.twin")

# No fast-math and no contraction: a run gives the same bits with every compiler and every vector width.
FLAGS = ("-O3", "-std=gnu99", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi",
         "-fPIC", "-shared")  # fmt: skip
NATIVE = "-march=native"


def find_compiler() -> tuple[str, ...] | None:
    """Command of a C compiler: `$CC`, cc, gcc, clang, or the `ziglang` package; None when there is none."""
    own = os.environ.get("CC", "").split()
    if own and shutil.which(own[0]):
        return tuple(own)
    for name in ("cc", "gcc", "clang"):
        path = shutil.which(name)
        if path:
            return (path,)
    if importlib.util.find_spec("ziglang") is not None:
        return (sys.executable, "-m", "ziglang", "cc")
    return None


def load(name: str, what: str | None, source: Callable[[], str]) -> ctypes.CDLL | None:
    """The shared library of a source; None where it cannot be compiled, which is logged once.

    Args:
        name: of the source, for the log.
        what, source: as in `remembered`.
    """
    command = find_compiler()
    try:
        if command is not None:
            return ctypes.CDLL(str(remembered(what, source, command)))
        say("no C compiler: the twin runs in CasADi's virtual machine, many times slower; "
            "install a compiler or the ziglang package")  # fmt: skip
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        say(f"{name} could not be compiled ({error}): it runs in CasADi's virtual machine")
    return None


def remembered(what: str | None, source: Callable[[], str], compiler: tuple[str, ...]) -> Path:
    """Path of the shared library of a source that follows from `what` (None: it does not).

    Where the library is cached, the source is not even written, which saves building its graph.

    Raises:
        OSError, subprocess.SubprocessError: as `compiled`.
    """
    if what is None:
        return compiled(source(), compiler)
    note = cache_folder() / f"{_name(what, compiler)}.is"
    known = library_cache.noted(note)
    if known is not None:
        return known
    path = compiled(source(), compiler)
    library_cache.write_note(note, path)
    return path


def compiled(source: str, compiler: tuple[str, ...]) -> Path:
    """Path of the shared library, from the cache or freshly compiled (written atomically).

    Raises:
        OSError, subprocess.SubprocessError: the compiler cannot be run or fails (the text is its last line).
    """
    target = cache_folder() / f"{_name(source, compiler)}.so"
    if library_cache.is_whole(target):
        return target
    try:
        return _compile_into(target, source, compiler)
    except OSError as error:  # a read-only or full home: compile for this process only
        LOG.info("no cache in %s (%s)", target.parent, error)
        return _compile_into(process_folder() / target.name, source, compiler)


def _name(text: str, compiler: tuple[str, ...]) -> str:
    key = "\0".join([text, *FLAGS, *compiler, _version(compiler), sys.platform, processor()])
    return f"twin-{hashlib.sha256(key.encode()).hexdigest()[:24]}"


@functools.cache
def _version(compiler: tuple[str, ...]) -> str:
    done = subprocess.run([*compiler, "--version"], capture_output=True, text=True, timeout=60, check=True)
    return done.stdout


@functools.cache
def processor() -> str:
    """Architecture and instruction sets: a home shared by machines keeps one library for each kind."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            flags = next((line for line in file if line.startswith(("flags", "Features"))), "")
    except OSError:
        flags = platform.processor()
    return f"{platform.machine()} {flags.strip()}"


def _compile_into(target: Path, source: str, compiler: tuple[str, ...]) -> Path:
    with scratch_folder(target.parent) as scratch:
        code, library = scratch / "twin.c", scratch / "twin.so"
        code.write_text(source, encoding="utf-8")
        message = ""
        for native in ((NATIVE,), ()):  # a compiler that does not know the processor takes its baseline
            command = [*compiler, *FLAGS, *native, "-o", str(library), str(code), "-lm"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
            if done.returncode == 0:
                return library_cache.keep(library, target)
            message = message or (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise subprocess.SubprocessError(f"{' '.join(compiler)}: {message}")
