"""Writers of recordings, one format a file."""

from terrafusion.datasets.writers.log_folder import write_log_folder
from terrafusion.datasets.writers.mcap import write_mcap

__all__ = ["write_log_folder", "write_mcap"]
