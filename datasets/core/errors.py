"""Errors that a user of terrafusion may see."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Self

from terrafusion.datasets.core.printable import printable


class TerrafusionError(Exception):
    """A known problem with an input or a request, in one line.

    The command line prints the message and exits with status 1; every other exception is a defect of
    this library.

    Args:
        what: what is wrong, with the offending value.
        file: the file (or folder, or catalogue name) it was found in.
        channel: the channel, topic, table or key inside that file.
        time_s: seconds from the start of the recording where it was found.
        remedy: what the user can do about it.
    """

    def __init__(
        self,
        what: str,
        *,
        file: str | Path | None = None,
        channel: str | None = None,
        time_s: float | None = None,
        remedy: str | None = None,
    ) -> None:
        self.what = what
        self.file = None if file is None else str(file)
        self.channel = channel
        self.time_s = time_s
        self.remedy = remedy
        where = [part for part in (self.file, channel) if part]
        if time_s is not None:
            where.append(f"t = {time_s:.3f} s")
        message = f"{', '.join(where)}: {what}" if where else what
        if remedy:
            message = f"{message}; {remedy}"
        super().__init__(printable(" ".join(message.split())))

    def of(self, file: str | Path | None) -> Self:
        """The same error of another file."""
        return type(self)(self.what, file=file, channel=self.channel, time_s=self.time_s, remedy=self.remedy)


class DataError(TerrafusionError):
    """A recording, or a part of it, that cannot be read or used."""


class ConfigError(TerrafusionError):
    """A parameter file with an unknown key, a wrong unit or a value out of range."""

    @classmethod
    def joined(cls, errors: "Sequence[ConfigError]") -> Self:
        """One error of several (at least one), a line each."""
        first = errors[0]
        error = cls(first.what, file=first.file, channel=first.channel, remedy=first.remedy)
        error.args = ("\n".join(str(one) for one in errors),)
        return error


@contextmanager
def errors_of(file: str | Path) -> Iterator[None]:
    """Adds the file to every DataError raised inside that does not name one."""
    try:
        yield
    except DataError as error:
        if error.file is not None:
            raise
        raise error.of(file) from None
