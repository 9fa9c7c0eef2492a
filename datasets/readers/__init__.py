"""Readers of recorded runs, one format a file; `open_recording` chooses by name and content.

    from terrafusion.datasets.readers import open_recording
    recording = open_recording("run.bag")  # or a log folder, .mcap, .db3, .csv, .pos, .nmea, "set/recording"

To add a format: write a module below this package (`ros`: bags, `sets`: files of public sets, `text`: text
and tables) with two functions, and list it in `formats.FORMATS`:

- `claims(path, head) -> bool`: whether the file is of this format, by its name and its first
  `HEAD_BYTES` bytes (none for a folder). It is asked for every file that is opened, so it is quick, imports
  no parser and never raises.
- `read(request) -> list[Recording]`: the recordings in it, in SI units and body axes as
  docs/reference/conventions.md states, times in int64 ns. What was assumed or left out goes into
  `Recording.notes`, what is wrong with the file into a `DataError` with place, value and remedy, to which the
  caller adds the name of the file (`errors_of`, where there are several). A time that runs backwards is
  refused unless `request.repair_clock` (`timed_tables`). Bytes are of unknown origin: no count is believed
  before it was compared with what is there.
- Optionally `companions(path) -> Sequence[Path]`: the files that are read with this one.

Helpers: `delimited` parses text tables, `text.fixes` places latitudes and longitudes, `channel_tables` makes
channels of columns with the log folder's names. Then add a sample to tests/datasets/fuzz_samples.py.
"""

from terrafusion.datasets.readers.open import (
    CUT_OFF,
    NOT_USED,
    files_of,
    hashes_of,
    open_recording,
    open_recordings,
)

__all__ = ["CUT_OFF", "NOT_USED", "files_of", "hashes_of", "open_recording", "open_recordings"]
