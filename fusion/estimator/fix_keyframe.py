"""The keyframe of a fix, and the motion of the antenna between both."""

from dataclasses import dataclass
from typing import Self

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.factors import antenna_lever
from terrafusion.fusion.graph.key_state import ANTENNA, GNSS_DELAY, cross
from terrafusion.fusion.inputs.validation import GnssFix

APART_NS = 1_000_000_000
"""Keyframes are closer than this; a fix farther from the next one came in a pause of the IMU."""


@dataclass(frozen=True, eq=False)
class AntennaMotion:
    """The antenna at a fix, by the state of the fix's keyframe.

    Attributes:
        offset_s: from the keyframe to the fix, less the delay that the chain estimates.
        delay_s: that delay.
        R: rotation (3, 3) body to ENU.
        rate_radps, accel_mps2: angular rate (3,), body; acceleration (3,), ENU.
        antenna_m: of the body (3,).
        lever_m: what the position factor adds to the body's position, without the antenna's state (3,), body.
        velocity_mps: of the antenna (3,), ENU.
    """

    offset_s: float
    delay_s: float
    R: Array
    rate_radps: Array
    accel_mps2: Array
    antenna_m: Array
    lever_m: Array
    velocity_mps: Array

    @classmethod
    def of(cls, chain: Chain, k: int, fix: GnssFix, antenna_m: Array) -> Self:
        """At a fix of keyframe k; `antenna_m` without what the chain estimates of it."""
        node, state = chain.node(k), chain.state(k)
        delay_s = float(state.of(GNSS_DELAY))
        offset_s = (fix.t_ns - node.t_ns) * 1e-9 - delay_s
        R = state.rotation
        rate = state.rate(node.gyro_radps)
        accel_world = R @ state.specific_force(node.accel_mps2)
        accel_world[2] -= GRAVITY_MPS2
        antenna = antenna_m.copy()
        antenna[:2] += state.of(ANTENNA)
        lever = antenna_lever(state, offset_s, rate, accel_world, antenna) - (antenna - antenna_m)
        velocity = state.velocity + accel_world * offset_s + R @ cross(rate, antenna)
        return cls(offset_s, delay_s, R, rate, accel_world, antenna, lever, velocity)


def keyframe_of(fix: GnssFix, chain: Chain) -> int | None:
    """The keyframe at or after a fix, its stamp corrected by the estimated delay; None in a pause."""
    t_ns = fix.t_ns
    if chain.dim > GNSS_DELAY:
        delay_s = float(chain.state(chain.last).of(GNSS_DELAY))
        t_ns = min(fix.t_ns - round(delay_s * 1e9), chain.nodes[-1].t_ns)
    k = chain.at_or_after(t_ns)
    return None if k is None or chain.node(k).t_ns - t_ns > APART_NS else k
