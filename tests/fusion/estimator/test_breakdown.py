"""Numbers that break down end a state, not the estimator."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.messages import Message
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.graph.chain import Chain
from tests.fusion.estimator.live_machine import drive


def add_all(estimator: Estimator, messages: Iterator[Message]) -> None:
    for message in messages:
        estimator.add(message)


@pytest.mark.parametrize("error", [ArithmeticError, OverflowError, RuntimeError, np.linalg.LinAlgError])
def test_it_starts_anew_says_so_and_goes_on(error: type[Exception], monkeypatch: pytest.MonkeyPatch) -> None:
    estimator, rest = Estimator.for_vehicle("elevate"), iter(drive())
    while estimator.latest() is None:
        estimator.add(next(rest))

    def fails(*_: object) -> None:
        raise error("a keyframe is not determined")

    monkeypatch.setattr(estimator.chain, "solve", fails)
    with pytest.raises(DataError, match="starts anew"):
        add_all(estimator, rest)
    assert estimator.latest() is None
    assert estimator.status in ("waiting", "aligning")
    assert estimator.breakdowns == 1
    add_all(estimator, rest)
    state = estimator.latest()
    assert state is not None
    assert np.isfinite(state.covariance).all()


def test_a_state_that_is_not_finite_is_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    estimator, rest = Estimator.for_vehicle("elevate"), iter(drive())
    while estimator.latest() is None:
        estimator.add(next(rest))
    unknown = property(lambda chain: np.full((chain.dim, chain.dim), np.nan))
    monkeypatch.setattr(Chain, "covariance", unknown)
    with pytest.raises(DataError, match="starts anew"):
        add_all(estimator, rest)


@pytest.mark.parametrize("error", [ZeroDivisionError, RuntimeError, KeyError])
@pytest.mark.parametrize("callback", ["on_state", "on_innovation"])
def test_an_error_of_a_callback_reaches_the_caller(callback: str, error: type[Exception]) -> None:
    def fails(_: object) -> None:
        raise error("of the caller")

    estimator = Estimator(Estimator.for_vehicle("elevate").config, **{callback: fails})
    with pytest.raises(error, match="of the caller"):
        add_all(estimator, iter(drive()))
    assert estimator.breakdowns == 0
    assert estimator.latest() is not None


def test_a_reset_estimator_is_as_a_new_one_with_its_callbacks() -> None:
    states: list[int] = []
    estimator = Estimator(Estimator.for_vehicle("elevate").config, on_state=lambda s: states.append(s.t_ns))
    add_all(estimator, iter(drive()[:1500]))
    first, dumped = list(states), estimator.dump()
    estimator.reset()
    assert estimator.latest() is None
    states.clear()
    add_all(estimator, iter(drive()[:1500]))
    assert states == first
    assert estimator.dump() == dumped
