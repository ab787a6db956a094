"""Runs on a real Ray cluster of two nodes, one of which is killed in the middle."""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.engines import RayEngine, run_process
from benchmarks.launch import jobs_left, launch

ray = pytest.importorskip("ray")
SMOKE = Path(__file__).parents[2] / "benchmarks" / "suites" / "smoke.yml"


@pytest.fixture
def cluster(monkeypatch):
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_worker_niceness", "0")  # other tests run beside it
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    yield cluster
    ray.shutdown()
    cluster.shutdown()


def test_a_lost_node_loses_no_run_and_none_is_done_twice(cluster, tmp_path):
    victim, _ = (cluster.add_node(num_cpus=1) for _ in range(2))
    engine = RayEngine(cluster.address)
    assert engine.cpus == 2
    jobs, _ = jobs_left(SMOKE, tmp_path)

    def lose_a_node():
        while sum(job.log.exists() for job in jobs) < 2:  # from then on both nodes are at work
            time.sleep(0.1)
        cluster.remove_node(victim, allow_graceful=False)

    with ThreadPoolExecutor(1) as pool:
        loss = pool.submit(lose_a_node)
        launch(jobs, at_once=2, retries=0, engine=engine)
        loss.result()
    assert [job.state for job in jobs] == ["finished"] * 4
    for job in jobs:
        assert pd.read_csv(job.directory / "evaluations.csv").timesteps.tolist() == [200, 400, 600]
        assert job.log.read_text().splitlines().count(str(job.directory)) == 1, "it came to its end once"
    attempts = [job.log.read_text().count("--- attempt") for job in jobs]
    assert sorted(attempts) == [1, 1, 1, 2], "the run on the lost node was started again, and no other"


def test_a_process_ends_with_the_one_that_started_it(tmp_path):
    """As when a node's worker is killed: nothing goes on writing to the run's directory."""
    import multiprocessing

    sign = tmp_path / "sign"
    program = f"import time, pathlib; pathlib.Path({str(sign)!r}).touch(); time.sleep(3); pathlib.Path({str(sign)!r}).unlink()"
    starter = multiprocessing.get_context("spawn").Process(
        target=run_process, args=([sys.executable, "-c", program], tmp_path / "log.txt")
    )
    starter.start()
    deadline = time.monotonic() + 30
    while not sign.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    starter.kill()
    starter.join()
    time.sleep(4)
    assert sign.exists(), "it lived on, and took its sign away"
