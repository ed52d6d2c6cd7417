"""Studies on toy stages: what variants share is made once, failures are named, a killed study goes on."""

import os
import signal
import subprocess
import sys
import time

import pytest

from pipeline.config.request import parse_request
from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from pipeline.run.job import open_job
from pipeline.run.process import make_results
from pipeline.store.artifact import Store
from pipeline.studies.ablation import FULL, ablate, variants_of
from pipeline.studies.measure import MeasurementCache
from pipeline.studies.search import seconds_of
from pipeline.studies.sweep import CHANCE, sweep_levels
from pipeline.studies.variants import LEAN, Base, Variant, base_of
from tests.pipeline.conftest import ToyProject

VARIANTS = (
    Variant("base"),
    Variant("longer", {"paint.iterations": "4"}),
    Variant("broken", {"bend.fail": "user"}),
    Variant("wrong", {"paint.iterations": "many"}),
    Variant("crashed", {"bend.fail": "bug"}),
    Variant("bent", {"bend.angle": "2"}),
)
GOOD = ("base", "longer", "bent")


def words_of(toy, **more):
    return {"data": str(toy.data), "stages": "tests.pipeline.toy_stages", **more}


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    """A project, its study's base, name -> result of every variant, and what is in use beside them."""
    toy = ToyProject(tmp_path_factory.mktemp("studied")).write()
    base = Base("ann", parse_request(words_of(toy)), toy.root / "study" / "log.txt")
    assert base.missing("paint", {}) == ["gather", "bend", "paint"]
    make_results(base.job({"bend.angle": "7"}))
    store = Store(toy.store)
    latest = {stage: store.latest("ann", stage).folder for stage in ("gather", "bend", "paint")}
    toy.ran()
    results = {one.name: base.run(one) for one in VARIANTS}
    assert sorted(toy.ran()) == ["bend:ann"] * 4 + ["paint:ann"] * 3  # what failed bent, too
    return toy, base, results, latest


def test_what_variants_share_is_made_once_and_never_again(studied):
    toy, base, results, _ = studied
    assert results["base"].folders["bend"] == results["longer"].folders["bend"]
    assert results["base"].folders["bend"] != results["bent"].folders["bend"]
    assert len({results[name].folders["paint"] for name in GOOD}) == 3
    again = {one.name: base.run(one) for one in VARIANTS if one.name in GOOD}
    assert toy.ran() == []
    assert {name: one.folders for name, one in again.items()} == {n: results[n].folders for n in GOOD}
    assert all(set(one.seconds) == {"gather", "bend", "paint"} for one in again.values())


def test_what_is_missing_of_a_variant_is_known_before_it_is_made(studied):
    _, base, _, _ = studied
    assert base.missing("paint", {}) == base.missing("bend", {}) == []
    assert base.missing("paint", {"paint.iterations": "9"}) == ["paint"]
    assert base.missing("paint", {"bend.angle": "9"}) == ["bend", "paint"]


def test_a_failing_variant_is_named_and_stops_no_other(studied):
    _, _, results, _ = studied
    assert [name for name, one in results.items() if one.failure] == ["broken", "wrong", "crashed"]
    assert "clip.mp4: is not a clip; name another" in results["broken"].failure
    assert "paint.iterations" in results["wrong"].failure
    assert "ZeroDivisionError" in results["crashed"].failure
    assert "broken" in results["broken"].line and "is not a clip" in results["broken"].line
    assert not results["broken"].folders and not results["broken"].means


def test_what_was_in_use_stays_in_use(studied):
    toy, _, _, before = studied
    assert {stage: Store(toy.store).latest("ann", stage).folder for stage in before} == before


STUDY = """
import sys
from pathlib import Path
from pipeline.config.request import parse_request
from pipeline.studies.variants import Base, Variant
data, log = sys.argv[1:]
words = {"data": data, "stages": "tests.pipeline.toy_stages", "paint.iterations": "40", "paint.rate": "0.05"}
base = Base("ann", parse_request(words), Path(log))
assert not any(base.run(one).failure for one in (Variant("one"), Variant("two", {"bend.angle": "2"})))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_a_study_killed_outright_goes_on_where_it_was(toy):
    line = [sys.executable, "-c", STUDY, str(toy.data), str(toy.root / "log.txt")]
    first = subprocess.Popen(line, cwd=REPOSITORY, env=toy.environment(), stdout=subprocess.DEVNULL)
    counts = toy.store / "ann" / "paint"
    deadline = time.monotonic() + 60
    while not any(counts.glob(".*/**/count.txt")) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.3)
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    time.sleep(0.3)  # the kernel ends the stage's process too
    toy.ran()
    done = subprocess.run(line, cwd=REPOSITORY, env=toy.environment(), capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert toy.ran() == ["paint:ann", "bend:ann", "paint:ann"]
    began = [int(line) for line in (toy.data / "began.log").read_text().split()]
    assert began[0] == 0 and began[1] > 0 and began[2] == 0


def test_a_base_is_the_command_line_on_top_of_its_scale(toy):
    def own(subject, words):
        return base_of(subject, parse_request(words), toy.root / "log.txt").request.overrides

    words = {"subject": "smile", "budget": "3m", "scale": "small", "train.subdivisions": "1"}
    found = own("smile", words)
    assert found["train.subdivisions"] == "1" and found["train.iterations"] == "200"
    assert 200 // int(found["train.held_out_every"]) >= 5 and found["evaluate.turntable_frames"] == "2"
    assert {f"evaluate.{name}" for name in LEAN} <= set(found)
    assert own("smile", {**words, "evaluate.turntable_frames": "9"})["evaluate.turntable_frames"] == "9"
    assert own("ann", words_of(toy)) == {}  # stages without such settings
    with pytest.raises(UserError, match="scale=huge"):
        own("smile", {"scale": "huge"})


def test_a_base_knows_the_preset_that_it_is_and_takes_another(toy):
    def base(**words):
        return base_of("smile", parse_request(words), toy.root / "log.txt")

    assert base().preset == "quick" and base(preset="draft").preset == "draft"
    assert base(**{"evaluate.turntable_frames": "9"}).preset == "quick"
    assert base(scale="small").preset == base(**{"train.lpips": "0"}).preset == ""
    own = base(**{"train.iterations": "7", "artifacts": str(toy.store)})
    other = own.under_preset("paper")
    assert other.settings["train"] == open_job("smile", parse_request({"preset": "paper"})).settings["train"]
    assert other.request.workspace == own.request.workspace


@pytest.mark.parametrize("subject", ["smile", "mannequin_head"])
@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_every_level_can_be_set_and_changes_something(subject, preset):
    base = open_job(subject, parse_request({"preset": preset}, subject))
    levels = sweep_levels(base.settings)
    parameters = [level.parameter for level in levels]
    assert {"steps", "number of Gaussians", "image size", "fit effort", "representation", "LPIPS"} <= {
        *parameters
    }
    assert ("precision" in parameters) == (preset == "paper")  # the heads of a triplane have one
    assert parameters.count(CHANCE) == 1
    firsts = len(dict.fromkeys(parameters))
    assert len(set(parameters[:firsts])) == firsts  # each parameter's first level before any second one
    for level in levels:
        changed = open_job(subject, parse_request({"preset": preset, **dict(level.overrides)}, subject))
        assert changed.settings != base.settings, level.label
        assert level.factor > 0


def test_every_part_of_the_method_can_be_left_out(tmp_path):
    base = base_of("smile", parse_request({}), tmp_path / "log.txt", views=True)
    assert base.settings["auxiliary"].generator == "auto"
    for key, variant in variants_of(base).items():
        assert (base.job(variant.overrides).settings == base.settings) == (key == FULL)


def levels_of(parameter, subject="smile", **words):
    levels = sweep_levels(open_job(subject, parse_request(words, subject)).settings)
    return [level for level in levels if level.parameter == parameter]


@pytest.mark.parametrize(
    ("subject", "overrides"),
    [("smile", {"ingest.long_side": "256"}), ("mannequin_head", {"ingest.mannequin_size": "128"})],
)
def test_a_size_is_asked_for_where_ingest_takes_it_from(subject, overrides):
    assert dict(levels_of("image size", subject)[0].overrides) == overrides


@pytest.mark.parametrize(
    ("words", "own", "others"),
    [
        ({}, "at most one subdivision", "012"),  # the plan may have left none
        ({"plan.subdivision": "on"}, "one subdivision", "02"),
        ({"plan.subdivision": "off"}, "no subdivision", "12"),
        ({"train.subdivisions": "0"}, "no subdivision", "12"),
    ],
)
def test_the_number_of_gaussians_is_varied_whatever_the_plan_says(words, own, others):
    levels = levels_of("number of Gaussians", **{"train.representation": "triplane", **words})
    assert {level.before for level in levels} == {own}
    assert "".join(dict(level.overrides)["train.subdivisions"] for level in levels) == others
    assert all(dict(level.overrides)["plan.subdivision"] == "on" for level in levels)


def test_the_density_of_bases_is_varied_by_their_longest_edge():
    levels = levels_of("number of Gaussians", **{"plan.edge_pixels": "4"})
    assert [dict(level.overrides)["plan.edge_pixels"] for level in levels] == ["6", "2.8"]
    assert levels[0].factor < 1 < levels[1].factor  # the coarser mesh first: it is the faster


def test_steps_are_varied_by_what_decides_them():
    assert dict(levels_of("steps")[0].overrides) == {"train.effort": "0.5"}
    assert dict(levels_of("steps", **{"train.iterations": "300"})[0].overrides) == {"train.iterations": "150"}


def test_a_part_is_left_out_where_it_is_and_added_where_it_can_be():
    on, off = (levels_of("LPIPS", **{"train.lpips": weight})[0] for weight in ("0.1", "0"))
    assert dict(on.overrides) == {"train.lpips": "0"} and on.factor < 1 < off.factor
    assert float(dict(off.overrides)["train.lpips"]) > 0
    assert levels_of("visibility gate") and not levels_of("visibility gate", **{"train.gate": "false"})


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("20m", 1200), ("1.5h", 5400), ("45", 45)])
def test_budgets(text, seconds):
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "-3m", "0", "m", "nan", "inf"])
def test_no_budgets(text):
    with pytest.raises(UserError, match="no length of time"):
        seconds_of(text)


def test_what_is_in_the_cache_is_not_lost(tmp_path):
    cache = MeasurementCache(tmp_path / "measured")
    assert cache.read("a") is None
    assert cache.write("a", {"ms": 2.5, "unknown": float("nan")}) == cache.read("a") == {"ms": 2.5}
    (tmp_path / "measured" / "a.json").write_text("{")  # cut off
    assert cache.read("a") is None


def test_the_dag_refuses_what_a_study_cannot_be_told(toy):
    words = ("tradeoff", "ablate", "subject=ann", "budget=soon", "scale=huge")
    run = toy.doit(*words, options=("--continue",))
    assert run.returncode != 0 and "Traceback" not in run.stdout + run.stderr
    assert "no length of time" in run.stderr + run.stdout
    assert "there are preset, small" in run.stderr + run.stdout
    with pytest.raises(UserError, match="there is no"):
        ablate("nobody", ["nobody"], toy.request())
    assert toy.ran() == [] and not (toy.data / "studies").exists()
