"""The blind check's result as a page: what `terrafusion gap-blind` writes beside its numbers."""
