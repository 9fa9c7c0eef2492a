"""The blind check of the diagnosis: trials made by a plant that is not the twin, answers, scores."""
