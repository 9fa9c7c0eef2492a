"""The same sweep on a real Dask cluster of processes: same bits, and clear words when it fails."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from terrafusion.datasets.core.errors import ConfigError, TerrafusionError
from terrafusion.twin import executors
from terrafusion.twin.sweep.load import load_sweep
from terrafusion.twin.sweep.plan import Sweep
from terrafusion.twin.sweep.run import run_sweep
from tests.dask_cluster import PATIENCE_S, scheduler, started, wait_for_workers, worker

pytest.importorskip("distributed", reason="distributed is not installed: pip install 'terrafusion[cluster]'")

SWEEP = """\
scenario: drive.yaml
axes:
  terrain: [asphalt, loose_sand]
  friction: {from: 0.2, to: 0.8, count: 8}
  slope_deg: [0, 3, 6, 9]
"""


def sweep_of(folder: Path, duration_s: int = 2) -> Sweep:
    (folder / "drive.yaml").write_text(f"drive: [{{duration_s: {duration_s}, v_mps: 1.0}}]\n")
    (folder / "own.yaml").write_text(SWEEP)
    return load_sweep(folder / "own.yaml")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a scheduler with two worker processes."""
    with scheduler(tmp_path_factory.mktemp("dask")) as address, worker(address), worker(address):
        wait_for_workers(address, 2)
        yield address


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The table of the sweep over drives of 20 s, from one process."""
    folder = tmp_path_factory.mktemp("whole")
    return run_sweep(sweep_of(folder, duration_s=20), folder / "out")


def test_a_cluster_gives_the_same_bits_as_one_process(cluster: str, tmp_path: Path) -> None:
    sweep = sweep_of(tmp_path)
    run_sweep(sweep, tmp_path / "here")
    run_sweep(sweep, tmp_path / "there", backend="dask", address=cluster)
    here, there = ((tmp_path / name / "runs.parquet").read_bytes() for name in ("here", "there"))
    assert here == there


def test_an_interrupted_sweep_moves_to_the_cluster(cluster: str, tmp_path: Path) -> None:
    sweep = sweep_of(tmp_path)
    whole = run_sweep(sweep, tmp_path / "whole")

    def interrupt(share: float) -> None:
        if share > 0.4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_sweep(sweep, tmp_path / "out", progress=interrupt)
    shares: list[float] = []
    table = run_sweep(sweep, tmp_path / "out", backend="dask", address=cluster, progress=shares.append)
    assert table.equals(whole)
    assert shares[0] > 0.4


def test_a_refused_address_is_reported_within_ten_seconds(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    _fails_fast(tmp_path, f"tcp://127.0.0.1:{port}", "no Dask scheduler answers .*refused.*dask scheduler")


def test_a_silent_address_is_reported_within_ten_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert executors.CONNECT_S <= 8.0  # leaves the other two
    monkeypatch.setattr(executors, "CONNECT_S", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        _fails_fast(tmp_path, f"tcp://127.0.0.1:{port}", "no Dask scheduler answers .*timed out", 3.0)


def test_another_kind_of_server_is_reported_as_such(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            line, _ = server.accept()
            with line:
                line.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        _fails_fast(tmp_path, address, "no Dask scheduler answers .*something else")
        thread.join()


@pytest.mark.parametrize("address", ["127.0.0.1:8786", "http://127.0.0.1:8786", "tcp://:8786", "tcp://host"])
def test_what_is_no_address_is_refused(tmp_path: Path, address: str) -> None:
    with pytest.raises(ConfigError, match=r"is no address of a scheduler; give one such as tcp://"):
        run_sweep(sweep_of(tmp_path), tmp_path / "out", backend="dask", address=address)


def test_a_scheduler_without_workers_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "CONNECT_S", 2.0)
    with scheduler(tmp_path) as address:
        _fails_fast(tmp_path, address, "the Dask scheduler has no worker; start some: `dask worker tcp://")


def test_other_versions_are_reported(cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "version", lambda: "9.9")
    _fails_fast(
        tmp_path, cluster, r"the worker tcp://\S+ has terrafusion \S+, here it is 9.9; install the same"
    )


def test_dead_workers_are_reported_and_nothing_finished_is_lost(
    whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executors, "WORKERLESS_S", 2.0)
    sweep = sweep_of(tmp_path, duration_s=20)
    with scheduler(tmp_path) as address:
        with worker(address) as only:
            wait_for_workers(address, 1)

            def kill(share: float) -> None:
                if share > 0.2:
                    only.kill()

            with pytest.raises(TerrafusionError, match=r"no workers any more; start some: .* continues"):
                run_sweep(sweep, tmp_path / "out", backend="dask", address=address, progress=kill)
        assert list((tmp_path / "out" / "parts").glob("part-*.parquet"))
        with worker(address):
            wait_for_workers(address, 1)
            again = run_sweep(sweep, tmp_path / "out", backend="dask", address=address)
    assert again.equals(whole)


def test_the_work_of_a_dead_worker_is_done_by_others(whole: Any, tmp_path: Path) -> None:
    sweep = sweep_of(tmp_path, duration_s=20)
    with scheduler(tmp_path) as address, worker(address), worker(address) as mortal:
        wait_for_workers(address, 2)
        table = run_sweep(
            sweep, tmp_path / "out", backend="dask", address=address, progress=lambda share: mortal.kill()
        )
        mortal.join(PATIENCE_S)
        assert mortal.exitcode == -signal.SIGKILL
    assert table.equals(whole)


def test_a_lost_scheduler_is_reported(tmp_path: Path) -> None:
    sweep = sweep_of(tmp_path, duration_s=20)
    with contextlib.ExitStack() as running:
        file = tmp_path / "scheduler.json"
        options = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
        boss = running.enter_context(started("scheduler", *options))
        limit = time.monotonic() + PATIENCE_S
        while not file.is_file() or not file.read_text().strip():
            assert time.monotonic() < limit
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        running.enter_context(worker(address, "--death-timeout", "5"))
        wait_for_workers(address, 1)

        def kill(share: float) -> None:
            boss.kill()

        begun = time.monotonic()
        with pytest.raises(TerrafusionError, match=r"lost|no workers any more"):
            run_sweep(sweep, tmp_path / "out", backend="dask", address=address, progress=kill)
        assert time.monotonic() - begun < 30.0


def _fails_fast(folder: Path, address: str, words: str, within_s: float = 10.0) -> None:
    begun = time.monotonic()
    with pytest.raises(TerrafusionError, match=words):
        run_sweep(sweep_of(folder), folder / "out", backend="dask", address=address)
    assert time.monotonic() - begun < within_s
