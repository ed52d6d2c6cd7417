"""Batches on a real Ray: started by itself, and a cluster of three nodes of which one is lost."""

import subprocess
import sys
import time

import pytest

from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from pipeline.run.ray_batch import Resources, fitting, import_ray, resources_of, way, without_dashboard
from pipeline.run.stage import Stage, load_stages

pytest.importorskip("ray", reason="Ray is not installed: pip install -e '.[cluster]'")
NAMES = ("one", "two", "three", "four", "five", "six")


@pytest.fixture
def six(toy):
    (toy.data / "datasets" / "six.toml").write_text('title = "six"\n[paint]\niterations = 60\nrate = 0.05\n')
    for name in NAMES:
        toy.subject(name, f'dataset = "six"\n[source]\npath = "sources/{name}.txt"\n')
        (toy.data / "sources" / f"{name}.txt").write_text(f"{name} ")
    return toy


def lines(path):
    return path.read_text().split() if path.exists() else []


@pytest.mark.slow
def test_a_local_ray_is_started_and_a_failure_comes_back(six):
    six.subject("two", 'dataset = "six"\n[source]\npath = "sources/two.txt"\n[bend]\nfail = "user"\n')
    run = six.doit("batch", "dataset=six", "cluster=local", "paint.iterations=2")
    assert run.returncode != 0
    assert "5 of 6 subjects done, 1 failed" in run.stdout
    assert "two    failed at bend: clip.mp4: is not a clip; name another" in run.stdout
    assert sorted(line for line in six.ran() if line.startswith("paint")) == sorted(
        f"paint:{name}" for name in NAMES if name != "two"
    )
    again = six.doit("batch", "dataset=six", "cluster=local", "paint.iterations=2", "bend.fail=")
    assert again.returncode == 0 and six.ran() == ["bend:two", "paint:two"]


@pytest.mark.slow
def test_a_node_is_lost_and_its_subjects_go_on_elsewhere(six):
    import_ray("local")
    from ray.cluster_utils import Cluster

    with without_dashboard():
        head = {"num_cpus": 1, "include_dashboard": False, "node_ip_address": "127.0.0.1"}
        cluster = Cluster(initialize_head=True, head_node_args=head)
        try:
            others = [cluster.add_node(num_cpus=1, node_ip_address="127.0.0.1") for _ in range(2)]
            cluster.wait_for_nodes()
            words = ["dataset=six", f"cluster={cluster.address}", *six.words()]
            batch = subprocess.Popen(
                [sys.executable, "-m", "doit", "run", "batch", *words],
                cwd=REPOSITORY, env=six.environment(),
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            )  # fmt: skip
            try:
                wait_until_all_paint(six, batch)
                before = lines(six.data / "ran.log")
                cluster.remove_node(others[-1], allow_graceful=False)
                said, _ = batch.communicate(timeout=200)
            finally:
                batch.kill()
        finally:
            cluster.shutdown()
    assert batch.returncode == 0, said
    assert "3 machine(s) with 3 CPUs" in said and "6 of 6 subjects done, 0 failed" in said
    check_nothing_twice(six, before)


def wait_until_all_paint(six, batch):
    """Until three subjects are in the middle of their last stage."""
    for _ in range(1200):
        counts = [int(p.read_text() or 0) for p in six.store.glob("*/paint/.scratch-*/work/count.txt")]
        if sum(count >= 5 for count in counts) == 3:
            return
        assert batch.poll() is None, batch.communicate()[0]
        time.sleep(0.05)
    raise AssertionError("three subjects never ran at once")


def check_nothing_twice(six, before):
    """Each stage ran once but the one that was lost, which went on at its checkpoint."""
    ran = lines(six.data / "ran.log")
    for stage in ("gather", "bend"):
        assert sorted(line for line in ran if line.startswith(stage)) == sorted(f"{stage}:{n}" for n in NAMES)
    painted = [line for line in ran if line.startswith("paint")]
    assert len(painted) == len(NAMES) + 1 and set(painted) == {f"paint:{name}" for name in NAMES}
    lost = next(line for line in set(painted) if painted.count(line) == 2)
    assert lost in before
    began = [int(line) for line in lines(six.data / "began.log")]
    assert sum(count >= 5 for count in began) == 1 and began.count(0) == len(NAMES)
    for name in NAMES:
        for stage in ("gather", "bend", "paint"):
            assert len(six.published(stage, name)) == 1
        assert (six.store / name / "paint" / "latest" / "painted.txt").read_text() == f"{name} 1.0" * 60
    assert six.doit(*(f"verify:{name}" for name in NAMES)).returncode == 0


class FakeRay:
    def __init__(self, *machines):
        self.machines = machines

    def nodes(self):
        return [{"Alive": True, "Resources": machine} for machine in self.machines]


def test_resources_come_from_the_preset_and_the_command_line(toy):
    (toy.data / "presets" / "quick.toml").write_text("[resources]\ncpus = 2\ngpus = 0.5\n")

    def given(*words):
        return resources_of(toy.request(*words))

    assert given() == Resources(2, 0.5)
    assert given("gpus=0") == Resources(2, 0)
    assert given("preset=balanced") == Resources(1, 0)
    (toy.data / "presets" / "quick.toml").write_text("[resources]\ncpus = -1\n")
    with pytest.raises(UserError, match=r"quick\.toml: resources\.cpus must be a number from 0"):
        given()


def test_a_batch_runs_what_doit_runs(toy):
    stages = load_stages("tests.pipeline.toy_stages")
    assert way(stages) == ["gather", "bend", "paint"]
    aside = Stage("aside", 1, object, "nowhere:run", needs={"gather": ("*",)})
    assert way({"gather": stages["gather"], "aside": aside, "bend": stages["bend"]}) == ["gather", "bend"]


def test_what_no_machine_has_is_said_and_cpus_are_fitted(capsys):
    ray = FakeRay({"CPU": 2.0}, {"CPU": 4.0, "GPU": 1.0})
    assert fitting(ray, Resources(8, 1)) == Resources(4, 1)
    assert "no machine has 8 CPUs" in capsys.readouterr().out
    with pytest.raises(UserError, match="gpus=0"):
        fitting(ray, Resources(1, 2))


def test_no_cluster_at_an_address_is_one_line(toy):
    run = toy.doit("batch", "subject=ann", "cluster=127.0.0.1:1")
    assert run.returncode != 0 and "there is no Ray cluster" in run.stdout + run.stderr
    assert "Traceback" not in run.stdout + run.stderr
