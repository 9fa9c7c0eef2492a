"""Readers of recorded drives, one format a file; `open_recording` chooses."""

from terrafusion.datasets.readers.open import files_of, open_recording, open_recordings

__all__ = ["files_of", "open_recording", "open_recordings"]
