"""Terrain-aware localisation of ground robots, and the honest comparison of a robot with its twin."""
