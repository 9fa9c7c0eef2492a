"""Paired statistics on errors whose ratios are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.fusion.benchmark.compare import contrasts, median_interval, shares
from terrafusion.fusion.benchmark.measure import GroundRow, Row, switch_delay_s
from terrafusion.fusion.benchmark.reasons import reasons
from terrafusion.fusion.benchmark.targets import MISSED, OPEN, REACHED, Target, nees_cells, targets
from terrafusion.fusion.benchmark.text import markdown, tables


def rows(arm: str, errors, family: str = "mixed", plant: str = "twin", **fields) -> list[Row]:
    return [
        Row(family, plant, f"seed {i}", f"seed {i}", arm, error_m=e, **fields) for i, e in enumerate(errors)
    ]


def spread(n: int = 40) -> np.ndarray:
    return np.exp(np.random.default_rng(0).normal(size=n))


def ground(name: str, forward: float, recognised: float = 0.5) -> GroundRow:
    return GroundRow(name, 10.0, forward, 0.01, 0.01, recognised, 1.0, 20.0, 1.0, 5.0)


@given(st.floats(0.1, 10.0))
def test_a_constant_ratio_is_found_whatever_the_drives(factor: float) -> None:
    base = spread(12)
    found = [
        c for c in contrasts(rows("fixed", base) + rows("adaptive", factor * base)) if c.arm == "adaptive"
    ]
    assert found[0].ratio == pytest.approx(factor)
    assert found[0].interval == pytest.approx((factor, factor))
    assert found[0].units == 12


def test_exchanging_two_arms_inverts_the_ratio_and_swaps_wins_and_losses() -> None:
    a, b = spread(), spread()[::-1]
    all_rows = rows("fixed", a) + rows("adaptive", b)
    forth = next(c for c in contrasts(all_rows, "fixed") if c.arm == "adaptive")
    back = next(c for c in contrasts(all_rows, "adaptive") if c.arm == "fixed")
    assert forth.ratio == pytest.approx(1.0 / back.ratio)
    assert forth.wins + forth.losses <= 40
    assert abs(forth.wins - back.losses) <= 2  # within 3 % of even the two margins differ a little


def test_pairing_takes_the_spread_of_the_drives_out() -> None:
    base = spread()
    noise = np.exp(0.05 * np.random.default_rng(1).normal(size=40))
    found = next(
        c for c in contrasts(rows("fixed", base) + rows("adaptive", 0.6 * base * noise)) if c.arm != "fixed"
    )
    assert found.interval is not None
    assert found.interval[0] < 0.6 < found.interval[1]
    assert found.interval[1] - found.interval[0] < 0.05


def test_drives_that_one_arm_lacks_are_left_out() -> None:
    found = contrasts(rows("fixed", [1.0, 1.0, None]) + rows("adaptive", [0.5, None, 0.1]))
    assert [(c.arm, c.units, c.ratio) for c in found] == [("fixed", 2, 1.0), ("adaptive", 1, 0.5)]
    assert found[1].interval is None


def test_outages_of_one_log_make_one_unit() -> None:
    def log(arm: str, errors: list[float]) -> list[Row]:
        return [Row("field", "firm", "log", f"outage {i}", arm, error_m=e) for i, e in enumerate(errors)]

    found = contrasts(log("fixed", [1.0, 2.0, 4.0]) + log("adaptive", [0.5, 1.0, 40.0]))
    assert found[1].units == 1
    assert found[1].ratio == pytest.approx(0.5)


def test_the_share_of_the_oracles_gain() -> None:
    base = spread()
    all_rows = rows("fixed", base) + rows("adaptive", 0.7 * base) + rows("oracle", 0.6 * base)
    assert shares(all_rows)[0].share == pytest.approx(0.75)
    assert shares(all_rows)[0].interval == pytest.approx((0.75, 0.75))
    none = rows("fixed", base) + rows("adaptive", 0.7 * base) + rows("oracle", base)
    assert shares(none)[0].share is None


def test_intervals_cover_the_median_as_often_as_they_say() -> None:
    rng = np.random.default_rng(5)
    covered = 0
    for _ in range(200):
        _, interval = median_interval(rng.normal(size=25).tolist())
        assert interval is not None
        covered += interval[0] <= 0.0 <= interval[1]
    assert 180 <= covered <= 200


@pytest.mark.parametrize(
    ("interval", "most", "verdict"),
    [
        ((0.4, 0.6), True, REACHED), ((0.4, 0.7), True, OPEN), ((0.7, 0.8), True, MISSED),
        ((0.7, 0.8), False, REACHED), ((0.4, 0.7), False, OPEN), ((0.3, 0.5), False, MISSED),
    ],
)  # fmt: skip
def test_verdicts_go_by_the_whole_interval(interval, most, verdict) -> None:
    assert Target("G0", "", 0.6, most, 0.5, interval).verdict() == verdict
    assert Target("G0", "", 0.6, most, 0.5, None).verdict() == OPEN
    assert Target("G0", "", 0.6, most, None, None).verdict() == "not measured"


def test_the_delay_of_a_switch_ends_where_the_grounds_agree_or_change_again() -> None:
    t = np.arange(8) * 10**9
    true = np.array([*"aabbbbcc"])
    assert switch_delay_s(t, true, np.array([*"aaaabbcc"])) == pytest.approx(1.0)  # 2 s, then at once
    assert switch_delay_s(t, true, np.array([*"aaaaaaaa"])) == pytest.approx(2.0)  # 3 s and 1 s, never seen
    assert switch_delay_s(t, np.array([*"aaaaaaaa"]), true) is None


def test_targets_of_a_benchmark_that_reaches_them() -> None:
    base = spread()
    found = {
        t.what: t.verdict()
        for t in targets(
            rows("fixed", base) + rows("innovation", base) + rows("adaptive", 0.5 * base)
            + rows("oracle", 0.45 * base) + rows("shuffled", 1.2 * base)
            + rows("adaptive", base, family="firm", outage_s=120.0, percent=0.3)
            + rows("fixed", base, family="firm")
        )
    }  # fmt: skip
    assert found == {
        "mixed, twin: adaptive over fixed": REACHED,
        "mixed, twin: adaptive over innovation": REACHED,
        "mixed, twin: share of the oracle's gain": REACHED,
        "mixed, twin: shuffled over fixed": MISSED,
        "firm, twin: adaptive over fixed": REACHED,
        "firm, twin: drift of adaptive in 120 s, % of the way": REACHED,
    }


def test_a_lost_family_names_detector_ground_and_error() -> None:
    base = spread(5)
    right = (ground("mud", 0.01), ground("asphalt", 0.01))
    wrong = (ground("mud", 0.30, recognised=0.1), ground("asphalt", 0.02))
    all_rows = (
        rows("fixed", base, grounds=right)
        + rows("adaptive", 2.0 * base, grounds=wrong)
        + rows("oracle", 0.8 * base)
    )
    (found,) = reasons(all_rows)
    assert (found.winner, found.blame(), found.ground) == ("fixed", "detector", "mud")
    assert "slip" in found.kind
    assert found.recognised == pytest.approx((0.3, 0.1))
    blamed = rows("fixed", base) + rows("adaptive", 2.0 * base) + rows("oracle", 1.5 * base)
    assert reasons(blamed)[0].blame() == "policy"
    assert reasons(rows("fixed", base) + rows("adaptive", 0.5 * base)) == []


def test_consistency_pools_the_drives_of_a_ground() -> None:
    cells = nees_cells(rows("adaptive", [1.0] * 6, grounds=(ground("mud", 0.1),)))
    assert {(c.terrain, c.mode, c.drives, c.mean) for c in cells} == {("mud", "twin, adaptive", 6, 1.0)}
    assert {c.verdict() for c in cells} == {"consistent"}


def test_tables_are_rectangular_and_tell_failures() -> None:
    base = spread(3)
    failed = [Row("mixed", "twin", "seed 9", "seed 9", "robust", failed="the start was not found")]
    made = tables(rows("fixed", base) + rows("adaptive", base) + failed)
    for table in made:
        assert {len(cells) for cells in table.rows} == {len(table.heads)}
        assert len({line.count("|") for line in markdown(table)[3:]}) == 1
    assert "the start was not found" in "\n".join(line for table in made for line in markdown(table))
