"""GPS time and UTC: the leap seconds between them."""

import numpy as np

from terrafusion.datasets.core.arrays import TimesNs

GPS_EPOCH_S = 315_964_800
"""Unix time of the GPS epoch, 1980-01-06 00:00:00 UTC."""

WEEK_S = 604_800
FULL_WEEK_MIN = 1024
"""Weeks before this one (August 1999) are treated as counted modulo 1024."""

LEAP_SECONDS = (
    ("1981-07-01", 1), ("1982-07-01", 2), ("1983-07-01", 3), ("1985-07-01", 4), ("1988-01-01", 5),
    ("1990-01-01", 6), ("1991-01-01", 7), ("1992-07-01", 8), ("1993-07-01", 9), ("1994-07-01", 10),
    ("1996-01-01", 11), ("1997-07-01", 12), ("1999-01-01", 13), ("2006-01-01", 14), ("2009-01-01", 15),
    ("2012-07-01", 16), ("2015-07-01", 17), ("2017-01-01", 18),
)  # fmt: skip
"""GPS time minus UTC, s, from each UTC date on (IERS Bulletin C, TAI - UTC less the constant 19 s)."""

KNOWN_UNTIL = "2027-06-28"
"""Date to which the bulletins rule out a further leap second."""

_FROM_UNIX_NS = np.array([date for date, _ in LEAP_SECONDS], dtype="datetime64[ns]").astype(np.int64)
_OFFSET_S = np.array([0, *(offset for _, offset in LEAP_SECONDS)], dtype=np.int64)


def gps_to_unix_ns(gps_ns: TimesNs) -> TimesNs:
    """Unix nanoseconds (N,) of GPS time, given as nanoseconds since the GPS epoch.

    Unix time repeats a second during a leap second.
    """
    without = gps_ns + GPS_EPOCH_S * 10**9
    starts = _FROM_UNIX_NS + _OFFSET_S[1:] * 10**9  # in GPS time, counted from the Unix epoch
    return without - _OFFSET_S[np.searchsorted(starts, without, side="right")] * 10**9


def leap_note(unix_ns: TimesNs) -> str:
    """A note on the leap seconds that were subtracted."""
    taken = np.unique(_OFFSET_S[np.searchsorted(_FROM_UNIX_NS, unix_ns[[0, -1]], side="right")])
    seconds = " and ".join(str(int(s)) for s in taken)
    late = int(unix_ns[-1]) > int(np.datetime64(KNOWN_UNTIL, "ns").astype(np.int64))
    doubt = f" (the table ends on {KNOWN_UNTIL}: a later leap second is not known)" if late else ""
    return f"gnss: GPS time to UTC: {seconds} leap seconds subtracted (IERS Bulletin C){doubt}"
