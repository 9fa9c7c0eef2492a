"""The command line inside the test process: exit status, standard output and standard error."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import hypothesis
import pytest

# The same examples in every run, and no time limit: a failure is neither bad luck nor a busy machine.
hypothesis.settings.register_profile("fixed", derandomize=True, deadline=None)
hypothesis.settings.load_profile("fixed")

# The matrices here are small: threads of the linear algebra only wait for each other on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


LONGEST = (
    "twin/gap/test_diagnose.py", "test_docs.py", "fusion/training/test_train_on_logs.py",
    "fusion/cli/test_replay_cli.py", "fusion/cli/test_init.py", "fusion/cli/test_demo_cli.py",
    "of_studies/test_source_study_cluster.py", "fusion/estimator/test_gnss.py",
    "twin/gap/blind/test_plant.py", "twin/gap/infer/test_other_drives.py", "twin/gap/test_effects_alike.py",
    "of_studies/test_survey.py", "twin/gap/null/test_reference_twin.py",
)  # fmt: skip
"""Files that take longest; they come first, or one of them would run alone at the end."""


def pytest_configure(config: pytest.Config) -> None:
    """Files of many tests are not the long ones, though xdist takes them to be."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    rank = {Path(__file__).parent / name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    status: int
    out: str
    err: str

    def refused(self, *words: str) -> str:
        """Assert that the command ended as a known error must: status 1, one line, each word in it.

        A YAML file has one line an error. Returns the lines: `assert terrafusion(...).refused(...)`.
        """
        assert self.status == 1, (self.status, self.out, self.err)
        assert self.err.startswith("error: "), self.err
        assert all(".yaml: " in line for line in self.err.splitlines()[1:]), self.err
        assert self.err.endswith("\n")
        assert max(map(len, self.err.splitlines())) < 1500, self.err
        for word in words:
            assert word in self.err, f"'{word}' is not told in: {self.err}"
        return self.err


Terrafusion = Callable[..., Outcome]
"""`terrafusion("replay", log, "--out", out)`."""


@pytest.fixture
def terrafusion(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Terrafusion:
    """Runs the console script's own `main`, with the descriptors captured, so that C++ is heard too."""

    from terrafusion.fusion.cli.main import main

    def run(*words: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["terrafusion", *map(str, words)])
        capfd.readouterr()
        status: object = 0
        try:
            main()
        except SystemExit as end:
            status = end.code or 0
        out, err = capfd.readouterr()
        assert isinstance(status, int)
        return Outcome(status, out, err)

    return run


@pytest.fixture(autouse=True)
def own_forms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Effects that a test registers are forgotten after it, so that no test depends on those before it."""
    monkeypatch.setattr("terrafusion.twin.effects.catalogue._OWN", {})


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replays write no page: for tests of ordinary drives that do not look at it. It takes a second."""
    monkeypatch.setattr("terrafusion.fusion.reports.replay.write_report", lambda *_, **__: None)


@pytest.fixture(scope="session")
def husky_bag() -> Path:
    """The public Husky bag, where the environment names the folder of field logs."""
    root = os.environ.get("TERRAFUSION_DATA")
    if not root:
        pytest.skip("TERRAFUSION_DATA is not set: the field logs are not at hand")
    bag = Path(root) / "husky_parkinglot" / "test1.bag"
    if not bag.is_file():
        pytest.skip("TERRAFUSION_DATA holds no husky_parkinglot/test1.bag")
    return bag
