"""What Ray costs against doit's ``-n``: ``python -m benchmarks.cluster [--quick] [--json FILE]``.

Six small subjects with three stages each, the last of which only waits, so that what is measured is not the
work but what starts it: doit with ``-n 2``, a batch on a local Ray that it starts by itself, and a batch on a
Ray cluster of two one-CPU nodes that already runs. All of them begin every stage as a process of its own and
have two subjects at a time. Then the same again with everything done: what looking at the store costs.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from pipeline.config.workspace import REPOSITORY
from pipeline.run.ray_batch import import_ray, without_dashboard

SUBJECTS, AT_ONCE, STEPS = 6, 2, 20
STAGES = "tests.pipeline.toy_stages"


@dataclasses.dataclass(frozen=True)
class Row:
    """One way to run the subjects.

    Attributes:
        name: of the way.
        wall: seconds from the command to its end, everything to do.
        again: the same with everything done.
        ideal: seconds that the last stages wait, two at a time.
    """

    name: str
    wall: float
    again: float
    ideal: float

    @property
    def overhead(self) -> float:
        """Seconds a subject beside the waiting."""
        return (self.wall - self.ideal) / SUBJECTS


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
        raise SystemExit(f"{' '.join(line)} failed:\n{done.stdout}{done.stderr}")
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


def measure(seconds: float) -> list[Row]:
    """All ways, one after the other."""
    ideal = math.ceil(SUBJECTS / AT_ONCE) * seconds
    with running_cluster() as address:
        ways = {
            "doit -n 2 -P thread": ("-n", str(AT_ONCE), "-P", "thread"),
            "batch, a local Ray started": ("batch", "cluster=local"),
            "batch, a cluster that runs": ("batch", f"cluster={address}"),
        }
        rows = []
        for name, words in ways.items():
            with tempfile.TemporaryDirectory() as folder:
                make_project(Path(folder))
                wall = run(Path(folder), seconds, *words)
                rows.append(Row(name, wall, run(Path(folder), seconds, *words), ideal))
                print(f"{name}: {wall:.1f} s", file=sys.stderr, flush=True)
    return rows


def main(arguments: list[str] | None = None) -> None:
    """Print the table and its headline."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="stages of one second in place of five")
    parser.add_argument("--json", type=Path, help="write the rows there too")
    options = parser.parse_args(arguments)
    seconds = 1.0 if options.quick else 5.0
    rows = measure(seconds)
    print(f"{SUBJECTS} subjects, {AT_ONCE} at a time, {seconds:g} s of waiting each")
    print(f"{'':28} {'wall s':>7} {'ideal s':>8} {'overhead a subject s':>21} {'all done already s':>19}")
    for row in rows:
        print(f"{row.name:28} {row.wall:7.1f} {row.ideal:8.1f} {row.overhead:21.2f} {row.again:19.1f}")
    if options.json:
        table = [{**dataclasses.asdict(row), "overhead": row.overhead} for row in rows]
        options.json.write_text(json.dumps(table, indent=1) + "\n")
    more = rows[2].overhead - rows[0].overhead
    start = rows[1].wall - rows[2].wall
    print(
        f"Ray on a running cluster costs {more:+.2f} s a subject against -n; starting one costs {start:.1f} s"
    )


if __name__ == "__main__":
    main()
