"""Slip predicted from wheels and IMU alone: a population of twin drives, features, model, judgement."""
