"""Decimal times to nanoseconds: none passes through a float."""

from __future__ import annotations

from decimal import ROUND_HALF_EVEN, Decimal

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.decimals import NS_PER, NotADecimal, to_ns

NUMBERS = st.from_regex(r"\A[+-]?\d{1,12}(\.\d{0,14})?\Z") | st.from_regex(r"\A-?\d\.\d{0,9}[eE][+-]?\d\Z")


@settings(max_examples=150, deadline=None)
@given(st.lists(NUMBERS, min_size=1, max_size=8), st.sampled_from(list(NS_PER)))
@example(["9223372036.854775807", "-9223372036.854775807"], "s")
@example(["1700000000.123456789", "8999999999.999999999", "9000000000.0", " 00001.5 ", "1.", "+.5"], "s")
@example(["1.0000000005", "1.0000000015", "-0.0000000005"], "s")
def test_as_decimal_says(texts: list[str], unit: str) -> None:
    if any(not text.isascii() for text in texts):
        return  # \d matches digits of other scripts too
    exact = [
        int((Decimal(t.strip()) * NS_PER[unit]).to_integral_value(rounding=ROUND_HALF_EVEN)) for t in texts
    ]
    if any(abs(ns) >= 2**63 for ns in exact):
        with pytest.raises(NotADecimal):
            to_ns(texts, unit)
    else:
        assert to_ns(texts, unit).tolist() == exact


@pytest.mark.parametrize(
    "text",
    ["", "-", ".", "x", "1-2", "+-1", "1.2.3", "nan", "-inf", "1_0", "0x1", "1e999999999", "99999999999",
     "9223372036.854775808", "é", "٣", "1" * 41, "1 2", "1e"],
)  # fmt: skip
def test_what_is_no_time(text: str) -> None:
    with pytest.raises(NotADecimal) as error:
        to_ns(["1.5", text])
    assert error.value.row == 1


def test_no_times() -> None:
    assert to_ns([]).tolist() == []
