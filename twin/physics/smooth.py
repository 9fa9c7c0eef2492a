"""Smooth stand-ins for |x|, max and min: CasADi expressions with derivatives of every order everywhere."""

from typing import Any

import casadi as ca

Scalar = Any
"""A CasADi SX scalar or a float."""


def smooth_abs(value: Scalar, width: float) -> Scalar:
    """|value|, rounded within `width` of zero, never below `width`."""
    return ca.sqrt(value * value + width * width)


def smooth_max(a: Scalar, b: Scalar, width: float) -> Scalar:
    """The larger of a and b, rounded where they differ by less than `width`."""
    return 0.5 * (a + b + smooth_abs(a - b, width))


def smooth_min(a: Scalar, b: Scalar, width: float) -> Scalar:
    """The smaller of a and b, rounded where they differ by less than `width`."""
    return 0.5 * (a + b - smooth_abs(a - b, width))


def grown(value: Scalar, length: float) -> Scalar:
    """From 0 at 0 towards 1 for either sign of `value`, 1/2 at `length`."""
    return value * value / (value * value + length * length)


def saturate(value: Scalar, limit: Scalar) -> Scalar:
    """value / (1 + (value/limit)^8)^(1/8) for value >= 0: identity when small, `limit` when large.

    At 0.8 of the limit it lies 2 % below the identity.
    """
    ratio = value / limit
    square = ratio * ratio
    fourth = square * square
    return value / ca.sqrt(ca.sqrt(ca.sqrt(1.0 + fourth * fourth)))
