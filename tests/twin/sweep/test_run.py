"""Sweeps on the disk: the same bits for any number of workers, nothing lost or done twice after a kill."""

from __future__ import annotations

import builtins
import json
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from terrafusion.datasets.core.errors import ConfigError, TerrafusionError
from terrafusion.datasets.core.scratch import machine
from terrafusion.twin.executors import open_workers
from terrafusion.twin.sweep import run as module
from terrafusion.twin.sweep.load import load_sweep
from terrafusion.twin.sweep.plan import Sweep, SweepPoint
from terrafusion.twin.sweep.recordings import write_recordings
from terrafusion.twin.sweep.rows import columns
from terrafusion.twin.sweep.run import read_table, run_sweep

SWEEP = """\
scenario: drive.yaml
axes:
  terrain: [asphalt, loose_sand]
  friction: {from: 0.2, to: 0.8, count: 8}
  slope_deg: [0, 3, 6, 9]
"""
PROGRAM = (
    "import sys; from terrafusion.twin.sweep.load import load_sweep; "
    "from terrafusion.twin.sweep.run import run_sweep; run_sweep(load_sweep(sys.argv[1]), sys.argv[2])"
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "drive.yaml").write_text("drive: [{duration_s: 2, v_mps: 1.0}]\n")
    (tmp_path / "own.yaml").write_text(SWEEP)
    return tmp_path / "own.yaml"


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of the runs that are computed in this process."""
    runs: list[int] = []
    original = module.run_chunk

    def counting(sweep: Sweep, cases: Sequence[SweepPoint]) -> Any:
        runs.extend(case.run for case in cases)
        return original(sweep, cases)

    monkeypatch.setattr(module, "run_chunk", counting)
    return runs


def _wait_for_parts(out: Path, count: int, child: subprocess.Popen[Any]) -> None:
    limit = time.monotonic() + 60.0
    while len(list((out / "parts").glob("part-*.parquet"))) < count:
        assert child.poll() is None, "the sweep ended before it could be stopped"
        assert time.monotonic() < limit
        time.sleep(0.002)


def test_order_and_bits_do_not_hang_on_the_number_of_workers(file: Path, tmp_path: Path) -> None:
    sweep = load_sweep(file)
    run_sweep(sweep, tmp_path / "one", jobs=1)
    run_sweep(sweep, tmp_path / "two", jobs=2)
    one, two = ((tmp_path / name / "runs.parquet").read_bytes() for name in ("one", "two"))
    assert one == two
    assert (tmp_path / "one" / "sweep.json").read_bytes() == (tmp_path / "two" / "sweep.json").read_bytes()


def test_a_killed_sweep_continues_without_loss(file: Path, tmp_path: Path, computed: list[int]) -> None:
    sweep = load_sweep(file)
    run_sweep(sweep, tmp_path / "whole")
    computed.clear()
    killed = tmp_path / "killed"
    child = subprocess.Popen([sys.executable, "-c", PROGRAM, str(file), str(killed)])
    _wait_for_parts(killed, 2, child)
    child.send_signal(signal.SIGKILL)
    child.wait()
    parts = killed / "parts"
    before = [part.name for part in parts.glob("part-*.parquet")]
    chunks = sweep.chunks()
    assert 2 <= len(before) < len(chunks)
    assert not json.loads((killed / "sweep.json").read_text())["complete"]
    finished = {run for part in before for run in chunks[int(part[5:11])]}

    shares: list[float] = []
    run_sweep(sweep, killed, progress=shares.append)
    assert sorted(computed) == [run for run in range(sweep.runs) if run not in finished]
    assert shares[0] > len(finished) / sweep.runs
    assert shares[-1] == 1.0
    for name in ("runs.parquet", "sweep.json"):
        assert (killed / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert not parts.exists()


def test_an_interrupted_sweep_ends_at_once_and_quietly(file: Path, tmp_path: Path) -> None:
    file.write_text(SWEEP.replace("[0, 3, 6, 9]", "{from: 0, to: 20, count: 500}"))
    call = PROGRAM.replace("sys.argv[2]", "sys.argv[2], jobs=2").replace("; run", "\ntry: run")
    program = f"{call}\nexcept KeyboardInterrupt: print('stopped', file=sys.stderr)"
    # A child of a suite that was started in the background would inherit that interrupts are ignored.
    program = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n{program}"
    words = [sys.executable, "-c", program, str(file), str(tmp_path / "out")]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as child:
        _wait_for_parts(tmp_path / "out", 2, child)
        child.send_signal(signal.SIGINT)
        begun = time.monotonic()
        try:
            _, said = child.communicate(timeout=60.0)
        finally:
            child.kill()  # one that does not end would be waited for without end
    assert time.monotonic() - begun < 10.0
    assert said == "stopped\n"


def test_a_worker_that_dies_is_reported() -> None:
    words = "a worker process died .* fewer --jobs; finished runs are kept"
    with pytest.raises(TerrafusionError, match=words), open_workers("loky", 2) as workers:
        list(workers.results(os._exit, [(1,)]))


def test_a_worker_that_is_replaced_is_no_news_and_other_warnings_are() -> None:
    replaced = "A worker stopped while some jobs were given to the executor. This can be ..."
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        with open_workers("loky", 2):
            warnings.warn(replaced, UserWarning, stacklevel=1)
            warnings.warn("another", UserWarning, stacklevel=1)
        warnings.warn(replaced, UserWarning, stacklevel=1)
    assert [str(one.message) for one in seen] == ["another", replaced]


@pytest.mark.parametrize(
    ("backend", "jobs", "address", "words"),
    [
        ("threads", 1, None, "unknown backend 'threads'; known are loky, dask"),
        ("loky", 0, None, "0 jobs; give a whole number from 1"),
        ("loky", 1, "tcp://127.0.0.1:1", "needs an address, and no other has one"),
        ("dask", 1, None, "needs an address, and no other has one"),
    ],
)
def test_options_that_make_no_sense_are_refused(
    backend: str, jobs: int, address: str | None, words: str
) -> None:
    with pytest.raises(ConfigError, match=words), open_workers(backend, jobs, address):
        pass


def test_a_finished_sweep_is_not_run_again(file: Path, tmp_path: Path, computed: list[int]) -> None:
    sweep = load_sweep(file)
    table = run_sweep(sweep, tmp_path / "out")
    computed.clear()
    assert run_sweep(sweep, tmp_path / "out").equals(table)
    assert computed == []


def test_a_damaged_part_is_computed_again(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = load_sweep(file)
    whole = run_sweep(sweep, tmp_path / "whole")

    def stopped(self: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module.Store, "assemble", stopped)
        with pytest.raises(KeyboardInterrupt):
            run_sweep(sweep, tmp_path / "out")
    parts = sorted((tmp_path / "out" / "parts").glob("part-*.parquet"))
    assert len(parts) == len(sweep.chunks())
    parts[0].write_bytes(parts[0].read_bytes()[:-100])
    os.truncate(parts[1], 0)
    assert module.Store(tmp_path / "out", sweep, sweep.chunks()).missing() == [0, 1]
    assert run_sweep(sweep, tmp_path / "out").equals(whole)


def test_a_changed_sweep_is_refused_with_the_remedy(file: Path, tmp_path: Path) -> None:
    run_sweep(load_sweep(file), tmp_path / "out")
    before = (tmp_path / "out" / "runs.parquet").read_bytes()
    file.write_text(SWEEP.replace("[0, 3, 6, 9]", "[0, 3, 6]"))
    with pytest.raises(ConfigError, match=r"out: the folder holds another sweep .*new --out, or remove"):
        run_sweep(load_sweep(file), tmp_path / "out")
    assert (tmp_path / "out" / "runs.parquet").read_bytes() == before


def test_a_sweep_of_another_version_is_refused(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_sweep(load_sweep(file), tmp_path / "out")
    for name in ("plan", "run"):
        monkeypatch.setattr(f"terrafusion.twin.sweep.{name}.model_sha256", lambda: "f" * 64)
    with pytest.raises(ConfigError, match="another version of terrafusion"):
        run_sweep(load_sweep(file), tmp_path / "out")


def test_a_folder_with_other_things_is_left_alone(file: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    with pytest.raises(ConfigError, match="not empty and holds no sweep"):
        run_sweep(load_sweep(file), tmp_path / "out")


def test_what_a_sweep_killed_at_its_begin_left_is_no_other_thing(file: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    part = tmp_path / "out" / f".sweep.json.{2**22 + 1}.{machine()}.part"
    part.write_text("{")
    run_sweep(load_sweep(file), tmp_path / "out")
    assert not part.exists()


@pytest.mark.parametrize("about", [0, 1])
def test_a_sweep_killed_at_its_begin_or_end_is_completed_by_the_next(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, about: int
) -> None:
    """Killed before it writes its sweep.json, first or last."""
    out, seen, write = tmp_path / "out", [], module.write_atomically

    def killed(path: Path, how: Any) -> Path:
        seen.append(path.name)
        if seen.count("sweep.json") > about:
            raise KeyboardInterrupt
        return write(path, how)

    with monkeypatch.context() as patch:
        patch.setattr(module, "write_atomically", killed)
        with pytest.raises(KeyboardInterrupt):
            run_sweep(load_sweep(file), out)
    run_sweep(load_sweep(file), out)
    assert json.loads((out / "sweep.json").read_text())["complete"]
    assert sorted(path.name for path in out.iterdir()) == ["runs.parquet", "sweep.json"]


def test_too_many_runs_are_refused_unless_asked_for(file: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"64 runs are more than 63; .*--max-runs"):
        run_sweep(load_sweep(file), tmp_path / "out", max_runs=63)
    assert not (tmp_path / "out").exists()


def test_columns_tell_what_they_hold(file: Path, tmp_path: Path) -> None:
    run_sweep(load_sweep(file), tmp_path / "out")
    schema = pq.read_schema(tmp_path / "out" / "runs.parquet")
    assert schema.names == [column.name for column in columns(sensors=False)]
    assert schema.field("energy_j").metadata[b"about"] == b"energy drawn from the battery, J"
    assert read_table(tmp_path / "out").column("run").to_pylist() == list(range(64))
    about = json.loads((tmp_path / "out" / "sweep.json").read_text())
    assert about["complete"] is True
    assert sum(about["outcome"].values()) == about["runs"] == 64
    assert about["config"]["vehicle"]["name"] == "elevate"
    assert str(tmp_path) not in json.dumps(about)


def test_without_pyarrow_one_line_says_what_to_install(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = builtins.__import__

    def without(name: str, *args: Any, **kw: Any) -> Any:
        if name.startswith("pyarrow"):
            raise ImportError(name)
        return original(name, *args, **kw)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(
        TerrafusionError, match=r"pyarrow is not installed; pip install 'terrafusion\[parquet\]'"
    ):
        run_sweep(load_sweep(file), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("form", ["folder", "mcap"])
def test_recordings_of_chosen_runs_hold_what_the_rows_say(file: Path, tmp_path: Path, form: str) -> None:
    from terrafusion.datasets.readers import open_recording

    sweep = load_sweep(file)
    table = run_sweep(sweep, tmp_path / "out")
    assert write_recordings(sweep, [3, 40], tmp_path / "logs", form=form) == []
    assert [path.stem for path in sorted((tmp_path / "logs").iterdir())] == ["run-000003", "run-000040"]
    for run in (3, 40):
        path = tmp_path / "logs" / (f"run-{run:06d}" + (".mcap" if form == "mcap" else ""))
        truth = open_recording(str(path)).truth
        assert truth is not None
        path_m = np.linalg.norm(np.diff(truth.position_m, axis=0), axis=1).sum()
        assert path_m == pytest.approx(table.column("distance_m")[run].as_py(), rel=1e-9)


def test_a_run_that_is_no_run_is_refused(file: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no run 64; give 0 to 63"):
        write_recordings(load_sweep(file), [64], tmp_path / "logs")
