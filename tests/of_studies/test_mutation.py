"""Mutants are other programs, one change each; one that a test notices is not one that survives."""

from __future__ import annotations

import ast

from tests.studies.mutation import mutant, outcome, places

SOURCE = "LIMIT = 3\n\ndef f(x):\n    return x > -LIMIT and x * 2.0\n"


def test_every_place_makes_a_program_of_its_own() -> None:
    count = len(list(places(ast.parse(SOURCE))))
    made = {mutant(SOURCE, i)[0] for i in range(count)}
    assert len(made) == count == 6
    assert ast.unparse(ast.parse(SOURCE)) not in made
    assert any("x <= -LIMIT" in text for text in made)
    assert any("x / 2.0" in text for text in made)


def test_a_change_that_tests_notice_is_told_from_one_that_they_do_not() -> None:
    target, tests = "fusion/inputs/gyro_unit.py", ("tests/fusion/inputs/test_gyro_unit.py",)
    broken = "raise ValueError"
    assert outcome(target, broken, tests) == "killed"
    assert outcome("fusion/inputs/nothing.py", broken, ("tests/of_studies/test_figures.py",)) == "survived"
