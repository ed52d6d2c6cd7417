"""The cost of Ray against doit's ``-n``.

Holds: docs/results.md, "Datasets". Needs the extra ``cluster``. Six small subjects with three stages each,
the last of which only waits, so that it is not the work that is measured but what starts it: doit with
``-n 2``, a batch on a local Ray that it starts by itself, and a batch on a Ray cluster of two one-CPU nodes
that already runs. All of them begin every stage as a process of its own and have two subjects at a time. Then
the same again with everything done: the cost of looking at the store.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks import frame
from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from pipeline.run.ray_batch import import_ray, without_dashboard

SUBJECTS, AT_ONCE, STEPS = 6, 2, 20
STAGES = "tests.pipeline.toy_stages"


def make_project(root: Path) -> None:
    """A data folder with the subjects."""
    data = root / "data"
    for folder in ("subjects", "presets", "datasets", "body", "sources"):
        (data / folder).mkdir(parents=True)
    (data / "assets.toml").write_text("")
    (data / "presets" / "quick.toml").write_text("[resources]\ncpus = 1\n")
    (data / "datasets" / "six.toml").write_text('title = "six"\n')
    for number in range(SUBJECTS):
        text = f'dataset = "six"\n[source]\npath = "sources/{number}.txt"\n'
        (data / "subjects" / f"s{number}.toml").write_text(text)
        (data / "sources" / f"{number}.txt").write_text(f"{number} ")


def run(root: Path, seconds: float, *words: str) -> float:
    """The wall time of one command, seconds."""
    line = [sys.executable, "-m", "doit", "run", *words, "dataset=six", f"data={root / 'data'}"]
    line += [f"stages={STAGES}", f"paint.iterations={STEPS}", f"paint.rate={seconds / STEPS}"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    start = time.monotonic()
    done = subprocess.run(line, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False)
    wall = time.monotonic() - start
    if done.returncode:
        raise UserError(f"{' '.join(line)} failed:\n{done.stdout}{done.stderr}")
    return wall


@contextlib.contextmanager
def running_cluster() -> Iterator[str]:
    """The address of a Ray cluster of one-CPU nodes on this machine."""
    import_ray("local")
    from ray.cluster_utils import Cluster

    with without_dashboard():
        head = {"num_cpus": 1, "include_dashboard": False, "node_ip_address": "127.0.0.1"}
        cluster = Cluster(initialize_head=True, head_node_args=head)
        try:
            for _ in range(AT_ONCE - 1):
                cluster.add_node(num_cpus=1, node_ip_address="127.0.0.1")
            cluster.wait_for_nodes()
            yield cluster.address
        finally:
            cluster.shutdown()


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Runs all ways, one after the other."""
    seconds = 1.0 if options.quick else 5.0
    ideal = math.ceil(SUBJECTS / AT_ONCE) * seconds
    with running_cluster() as address:
        ways = {
            "doit -n 2 -P thread": ("-n", str(AT_ONCE), "-P", "thread"),
            "batch, a local Ray started": ("batch", "cluster=local"),
            "batch, a cluster that runs": ("batch", f"cluster={address}"),
        }
        for name, words in ways.items():
            with tempfile.TemporaryDirectory() as folder:
                make_project(Path(folder))
                wall = run(Path(folder), seconds, *words)
                again = run(Path(folder), seconds, *words)
            overhead = (wall - ideal) / SUBJECTS
            row = {"way": name, "wall_s": wall, "ideal_s": ideal, "overhead_a_subject_s": overhead}
            report.add(row | {"all_done_already_s": again})
    doit, local, cluster = report.tables["rows"]
    more = cluster["overhead_a_subject_s"] - doit["overhead_a_subject_s"]
    start = local["wall_s"] - cluster["wall_s"]
    running = f"Ray on a running cluster costs {more:+.2f} s a subject against -n"
    return f"{running}; starting one costs {start:.1f} s"


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("cluster", __doc__, measure, arguments)


if __name__ == "__main__":
    sys.exit(main())
