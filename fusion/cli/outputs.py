"""Where a command writes: the default place, and what it may replace."""

import re
import time
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.files import check_folder, expanded
from terrafusion.datasets.core.scratch import UNFINISHED, is_part

ROOT = Path("terrafusion-out")
LOG_FILES = ("meta.yaml", "*.csv", "*.csv.gz")
OTHER_LOGS = (".bag", ".db3", ".csv", ".gz", ".zip")
FORCED = "give another name, or --force to replace it"


@dataclass(frozen=True)
class Output:
    """What a command writes at `--out`.

    Attributes:
        help: of the option `--out`.
        names: patterns of the entries of its folder; none for a single file.
        marks: entries that only this command writes: one of them shows whose folder it is. A text among
            them holds the word `mark`.
        suffix: of the single file.
        mark: word of a text that this command wrote; None: nothing is replaced.
        goes_on: whether the same command continues a stopped one.
    """

    help: str
    names: tuple[str, ...] = ()
    marks: tuple[str, ...] = ()
    suffix: str = ""
    mark: str | None = "terrafusion"
    goes_on: bool = False

    def place(self, out: Path | None, command: str, subject: str, force: bool) -> Path:
        """Where to write: `out`, or by default a new name of command, log and time; checked, not yet made.

        Raises:
            TerrafusionError: it cannot be written, or holds what the command did not write.
        """
        if out is None:
            out = default_name(command, subject, self.suffix)
        out = expanded(out)
        if self.suffix or out.suffix == ".mcap":
            check_file(out, force, self.mark)
        else:
            self._check_folder(out, force)
        return out

    def _check_folder(self, out: Path, force: bool) -> None:
        if out.suffix in OTHER_LOGS and set(LOG_FILES) <= {*self.names} and not out.is_dir():
            remedy = "give the name of a folder, or of a file ending in .mcap"
            raise TerrafusionError(f"a folder is written, no {out.suffix} file", file=out, remedy=remedy)
        check_folder(out)
        if force or not out.is_dir():
            return
        found = [path.name for path in sorted(out.iterdir()) if not is_part(path.name)]
        foreign = [name for name in found if not any(fnmatch(name, own) for own in self.names)]
        if foreign or (found and not any(self._is_own(out / mark) for mark in self.marks)):
            raise TerrafusionError(
                f"the folder is not empty and holds what this command did not write: {(foreign or found)[0]}",
                file=out,
                remedy="give an empty or new folder, or --force to write into it",
            )

    def _is_own(self, path: Path) -> bool:
        if path.suffix not in (".json", ".yaml"):
            return path.exists()
        return holds(path, self.mark) or holds(path, f"{UNFINISHED}: true")


def default_name(command: str, subject: str, suffix: str = "") -> Path:
    """A new path `terrafusion-out/<command>-<log>-YYYYmmdd-HHMMSS`; `subject`: path or name of the log."""
    stem = Path(subject).name.split(".")[0]
    words = [command.replace(" ", "-"), re.sub(r"[^\w+-]+", "-", stem).strip("-")]
    begun = time.time()
    while True:
        stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(begun))
        path = ROOT / ("-".join([*filter(None, words), stamp]) + suffix)
        if not path.exists():
            return path
        begun += 1.0


def parts_of(out: Path) -> Path:
    """Folder for the finished parts of a single file that takes long to make."""
    return out.with_name(f"{out.name}.parts")


def check_file(path: Path, force: bool = False, mark: str | None = None) -> None:
    """Refuse a file that cannot be written, or that is there and was not written by this library.

    Args:
        mark: a word of what the command writes: a file that holds it is replaced. None: none is.

    Raises:
        TerrafusionError: it cannot be written, or would be lost.
    """
    if path.is_dir():
        raise TerrafusionError(
            "is a folder and cannot be written", file=path, remedy="give the name of a file"
        )
    check_folder(path.absolute().parent)
    if path.exists() and not force and not holds(path, mark):
        raise TerrafusionError("exists already", file=path, remedy=FORCED)


def holds(path: Path, mark: str | None) -> bool:
    """Whether the head of a text file holds a word."""
    if mark is None:
        return False
    try:
        with path.open("rb") as file:
            return mark.encode() in file.read(65536)
    except OSError:
        return False
