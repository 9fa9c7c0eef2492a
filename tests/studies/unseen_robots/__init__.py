"""Robots that no part of the library made: rigid bodies in MuJoCo with sensors of their own, by seed."""
