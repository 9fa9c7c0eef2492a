"""Text for a terminal: that of foreign origin (names of files, channels and logs), and counts in words."""

import re

_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Controls but tab and newline, marks that turn the direction of writing, halves of surrogate pairs."""


def printable(text: str) -> str:
    """The text with escapes, such as \\x1b, in place of what is no character to be seen."""
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


def times(count: int) -> str:
    """How often, in words: "once", "3 times"."""
    return "once" if count == 1 else f"{count} times"


def counted(count: int, noun: str, plural: str = "") -> str:
    """Such as "1 gap", "3 gaps"; a `plural` that ends otherwise is given."""
    return f"{count} {noun}" if count == 1 else f"{count} {plural or noun + 's'}"
