"""Paired statistics on errors whose ratios are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.fusion.benchmark.compare import contrasts, median_interval, shares
from terrafusion.fusion.benchmark.reasons import reasons
from terrafusion.fusion.benchmark.run_score import GroundScore, RunScore, switch_delay_s
from terrafusion.fusion.benchmark.targets import MISSED, OPEN, REACHED, Target, pooled_nees, targets
from terrafusion.fusion.reports.benchmark import plot_ratios
from terrafusion.fusion.reports.benchmark_tables import tables
from terrafusion.fusion.reports.plots.sheet import Sheet


def rows(method: str, errors, family: str = "mixed", plant: str = "twin", **fields) -> list[RunScore]:
    return [
        RunScore(family, plant, f"seed {i}", f"seed {i}", method, error_m=e, **fields)
        for i, e in enumerate(errors)
    ]


def spread(n: int = 40) -> np.ndarray:
    return np.exp(np.random.default_rng(0).normal(size=n))


def ground(name: str, forward: float, recognised: float = 0.5) -> GroundScore:
    return GroundScore(name, 10.0, forward, 0.01, 0.01, recognised, 1.0, 20.0, 1.0, 5.0)


@given(st.floats(0.1, 10.0))
def test_a_constant_ratio_is_found_whatever_the_drives(factor: float) -> None:
    base = spread(12)
    found = [
        c for c in contrasts(rows("fixed", base) + rows("adaptive", factor * base)) if c.method == "adaptive"
    ]
    assert found[0].ratio == pytest.approx(factor)
    assert found[0].interval == pytest.approx((factor, factor))
    assert found[0].units == 12


def test_exchanging_two_arms_inverts_the_ratio_and_swaps_wins_and_losses() -> None:
    a, b = spread(), spread()[::-1]
    all_rows = rows("fixed", a) + rows("adaptive", b)
    forth = next(c for c in contrasts(all_rows, "fixed") if c.method == "adaptive")
    back = next(c for c in contrasts(all_rows, "adaptive") if c.method == "fixed")
    assert forth.ratio == pytest.approx(1.0 / back.ratio)
    assert forth.wins + forth.losses <= 40
    assert abs(forth.wins - back.losses) <= 2  # within 3 % of even the two margins differ a little


def test_pairing_takes_the_spread_of_the_drives_out() -> None:
    base = spread()
    noise = np.exp(0.05 * np.random.default_rng(1).normal(size=40))
    found = next(
        c
        for c in contrasts(rows("fixed", base) + rows("adaptive", 0.6 * base * noise))
        if c.method != "fixed"
    )
    assert found.interval is not None
    assert found.interval[0] < 0.6 < found.interval[1]
    assert found.interval[1] - found.interval[0] < 0.05


@pytest.mark.parametrize("units", range(2, 9))
def test_few_units_have_no_interval_and_decide_nothing(units: int) -> None:
    errors = np.linspace(0.4, 0.5, units)
    all_rows = rows("fixed", np.ones(units)) + rows("adaptive", errors) + rows("oracle", 0.9 * errors)
    found = next(c for c in contrasts(all_rows) if c.method == "adaptive")
    share = shares(all_rows)[0]
    assert (found.interval is None) == (share.interval is None) == (units < 6)
    verdict = next(t for t in targets(all_rows) if t.what == "mixed, twin: adaptive over fixed").verdict()
    assert verdict == (OPEN if units < 6 else REACHED)
    assert share.share is not None
    if found.interval is not None:  # of so few units, all of them
        assert found.interval == pytest.approx((0.4, 0.5))


def test_a_failed_replay_loses_and_where_the_base_failed_nothing_is_compared() -> None:
    def failing(method: str, unit: str) -> RunScore:
        return RunScore("mixed", "twin", unit, unit, method, failed="RuntimeError: singular")

    base = [failing("fixed", f"seed {i}") for i in (0, 1)] + rows("fixed", np.ones(12))[2:]
    own = [failing("adaptive", "seed 0"), *rows("adaptive", np.full(12, 0.5))[1:4]]
    own += [failing("adaptive", f"seed {i}") for i in range(4, 12)]
    found = next(c for c in contrasts(base + own) if c.method == "adaptive")
    assert (found.units, found.wins, found.losses, found.ratio) == (10, 2, 8, np.inf)
    assert found.interval == (0.5, np.inf)
    assert {t.verdict() for t in targets(base + own)} == {OPEN}
    text = "\n".join(line for table in tables(base + own) for line in table.markdown())
    assert "inf [0.50, inf]" in text
    sheet = Sheet()
    plot_ratios(sheet, contrasts(base + own))
    assert set(sheet.panels["ratios"].legend) == {"as large as that of fixed", "adaptive"}
    assert '"inf [0.5, inf]"' in sheet.json()
    assert shares(base + own + rows("oracle", np.full(12, 0.4)))[0].share == -np.inf


@pytest.mark.parametrize("trouble", [{"failed": "singular"}, {"error_m": 0.5, "diverged": "ran away"}])
def test_one_field_log_that_fails_or_diverges_misses_its_target(trouble) -> None:
    base, own = (
        rows(method, [e] * 8, family="field", plant="firm")
        for method, e in (("fixed", 1.0), ("adaptive", 0.5))
    )
    (sound,) = targets(base + own)
    assert (sound.name, sound.verdict()) == ("G9", REACHED)
    broken = dataclasses.replace(own[0], error_m=None)
    (target,) = targets([*base, *own[1:], dataclasses.replace(broken, **trouble)])
    assert (target.broken, target.verdict()) == (1, MISSED)
    (alone,) = targets([dataclasses.replace(broken, **trouble)])
    assert alone.verdict() == MISSED


def test_a_failed_replay_drifts_without_end() -> None:
    own = rows("adaptive", [1.0] * 6, family="firm", outage_s=120.0, percent=0.3)
    broken = [
        RunScore("firm", "twin", f"seed {i}", f"seed {i}", "adaptive", failed="singular") for i in (7, 8)
    ]
    assert [t.verdict() for t in targets(own)] == [REACHED]
    (target,) = targets(own + broken)
    assert (target.found, target.interval, target.verdict()) == (0.3, (0.3, np.inf), OPEN)


def test_an_arm_of_fewer_drives_tells_their_number() -> None:
    all_rows = rows("fixed", [1.0] * 8) + rows("adaptive", [0.9] * 8) + rows("oracle", [0.2] * 3)
    cells = tables(all_rows)[0].rows[0]
    assert cells[1] == "8"
    assert "0.20 (3)" in cells
    assert "0.90 [0.90, 0.90]" in cells


def test_drives_that_one_arm_lacks_are_left_out() -> None:
    found = contrasts(rows("fixed", [1.0, 1.0, None]) + rows("adaptive", [0.5, None, 0.1]))
    assert [(c.method, c.units, c.ratio) for c in found] == [("fixed", 2, 1.0), ("adaptive", 1, 0.5)]
    assert found[1].interval is None


def test_outages_of_one_log_make_one_unit() -> None:
    def log(method: str, errors: list[float]) -> list[RunScore]:
        return [
            RunScore("field", "firm", "log", f"outage {i}", method, error_m=e) for i, e in enumerate(errors)
        ]

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


@pytest.mark.parametrize("units", [6, 7, 8, 9, 20, 25])
def test_intervals_cover_the_median_at_least_as_often_as_they_say(units: int) -> None:
    rng = np.random.default_rng(5)
    covered = 0
    for _ in range(1000):
        _, interval = median_interval(rng.exponential(size=units).tolist())
        assert interval is not None
        covered += interval[0] <= np.log(2.0) <= interval[1]
    assert covered >= 936  # two standard deviations below 950


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
    assert switch_delay_s(t, true, true == [*"aaaabbcc"]) == pytest.approx(1.0)  # 2 s, then at once
    assert switch_delay_s(t, true, true == [*"aaaaaaaa"]) == pytest.approx(2.0)  # 3 s and 1 s, never seen
    assert switch_delay_s(t, np.full(8, "a"), true == "a") is None


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
        "firm, twin: drift of adaptive in 120 s, % of the distance": REACHED,
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
    cells = pooled_nees(rows("adaptive", [1.0] * 6, grounds=(ground("mud", 0.1),)))
    assert {(c.terrain, c.mode, c.drives, c.mean) for c in cells} == {("mud", "twin, adaptive", 6, 1.0)}
    assert {c.verdict() for c in cells} == {"consistent"}


def test_consistency_of_few_drives_has_no_interval_and_no_verdict() -> None:
    def cell(drives: int) -> str:
        made = tables(rows("adaptive", [1.0] * drives, grounds=(ground("mud", 0.1),)))
        return next(table for table in made if table.title == "Consistency").rows[0][3]

    assert cell(5) == "1.00"
    assert cell(6).startswith("1.00 [1.00, 1.00] = ")


def test_tables_are_rectangular_and_tell_failures() -> None:
    base = spread(3)
    failed = [RunScore("mixed", "twin", "seed 9", "seed 9", "robust", failed="the start was not found")]
    made = tables(rows("fixed", base) + rows("adaptive", base) + failed)
    for table in made:
        assert {len(cells) for cells in table.rows} == {len(table.heads)}
        assert len({line.count("|") for line in table.markdown()[3:]}) == 1
    assert "the start was not found" in "\n".join(line for table in made for line in table.markdown())
