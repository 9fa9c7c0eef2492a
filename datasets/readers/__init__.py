"""Readers of recorded drives, one format a file; `open_recording` chooses."""

from terrafusion.datasets.readers.open import open_recording, open_recordings

__all__ = ["open_recording", "open_recordings"]
