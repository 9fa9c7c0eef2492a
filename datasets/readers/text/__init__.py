"""Text that receivers and programs write, and tables of any columns."""
