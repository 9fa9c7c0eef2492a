"""Writers of recorded drives, one format a file."""

from terrafusion.datasets.writers.log_folder import write_log_folder

__all__ = ["write_log_folder"]
