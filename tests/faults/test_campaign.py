"""The campaign itself on toy stages: a few kills, and that it notices what it is there to notice."""

import json
import shutil
import sys

import pytest

from tests.faults.__main__ import headline, report
from tests.faults.campaign import CORRUPT, DIFFERENT, MANUAL, Campaign, Tally, plan, undisturbed
from tests.faults.observe import differences, litter, published, wrongs
from tests.faults.project import Project, toy_project
from tests.faults.runs import MOMENTS, TARGETS, Run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="it watches processes as Linux shows them"),
]
STAGES = ("gather", "bend", "paint")
SEED = 3


def test_killed_at_random_moments_and_then_the_same_command(tmp_path):
    project = toy_project(tmp_path)
    reference = undisturbed(project, tmp_path / "reference")
    tally = Campaign(project, reference, 8, SEED, tmp_path / "kept").run()
    print("\n".join(report(tally, SEED, STAGES)))
    assert tally.failures == [] and sum(tally.kills.values()) == 8 and tally.runs >= 1
    assert headline(tally).startswith("faults: 8 kills") and tally.mended
    assert sum(json.loads(json.dumps(tally.as_json()))["targets"].values()) == 8


def test_kills_are_drawn_from_a_seed_and_fall_on_every_stage():
    kills = [kill for kill, _ in zip(plan(STAGES, 1), range(80), strict=False)]
    assert kills == [kill for kill, _ in zip(plan(STAGES, 1), range(80), strict=False)]
    assert kills != [kill for kill, _ in zip(plan(STAGES, 2), range(80), strict=False)]
    assert {kill.stage for kill in kills} == {"", *STAGES}
    assert {kill.target for kill in kills} == set(TARGETS)
    assert {kill.moment for kill in kills} == {"", *MOMENTS}


def test_what_a_kill_must_not_leave_is_noticed(tmp_path):
    project = toy_project(tmp_path)
    reference = undisturbed(project, tmp_path / "reference")
    shutil.copytree(reference.folder, project.artifacts, symlinks=True)
    assert wrongs(project) == [] and litter(project) == []
    assert differences(reference.files, published(project)) == []

    folder = project.artifacts / "ann" / "bend"
    version = (folder / "latest").resolve()
    (version / "bent.txt").write_text("ann 1.1")
    assert differences(reference.files, published(project)) == [f"bend/{version.name}/bent.txt"]
    assert wrongs(project) == ["bend: damaged and visible: bent.txt"]
    (version / "manifest.json").unlink()
    assert wrongs(project) == [
        "bend: damaged and visible: manifest.json",
        f"bend: latest names {version.name}, which is no whole version",
    ]
    (folder / ".scratch-1").mkdir()
    assert litter(project) == ["bend/.scratch-1"]
    with project.store.scratch("ann", "bend", "2", lambda: None):
        assert "bend: .lock-2 is still held" in wrongs(project)


def test_a_run_that_fails_or_differs_is_counted(tmp_path):
    project = toy_project(tmp_path)
    reference = undisturbed(project, tmp_path / "reference")
    campaign = Campaign(project, reference, 1, SEED, tmp_path / "kept")
    changed = Project((*project.words, "bend.angle=3"), "ann", STAGES, project.artifacts)
    campaign.through(Run(changed))
    assert campaign.tally.count(DIFFERENT) > 0 and campaign.tally.count(CORRUPT) == 0
    failing = Project((*project.words, "bend.fail=user"), "ann", STAGES, project.artifacts)
    campaign.through(Run(failing))
    assert campaign.tally.count(MANUAL) == 1 and campaign.tally.runs == 1
    assert "1 manual steps" in headline(campaign.tally) and list((tmp_path / "kept").glob("*.log"))


def test_an_empty_tally_says_nothing_was_killed():
    assert headline(Tally()).startswith("faults: 0 kills, 0 whole runs")
