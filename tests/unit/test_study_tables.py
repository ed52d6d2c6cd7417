"""A study's tables, plots and page."""

import dataclasses
import html.parser
import json
import math
import re

import cv2
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.clip.curves import SCHEMA
from pipeline.config.request import parse_request
from pipeline.config.settings import read_toml
from pipeline.files.tables import write_table
from pipeline.studies import ablation
from pipeline.studies.ablation import (
    CHANCE,
    FULL,
    SAME,
    VARIANTS,
    counts_refined,
    headline,
    tables_of,
    values_of,
    write_ablation,
)
from pipeline.studies.fit_error import aligned_error
from pipeline.studies.measure import score_table
from pipeline.studies.plots import bars, curves, round_ticks, scatter
from pipeline.studies.points import point_table
from pipeline.studies.sweep import CHANCE as CHANCE_PARAMETER
from pipeline.studies.sweep import Level, label_of
from pipeline.studies.tables import LATEX, MAIN, METRICS, NOTE, Table, latex, markdown
from pipeline.studies.tradeoff import Tradeoff, write_tradeoff
from pipeline.studies.tradeoff import headline as pays
from pipeline.studies.tradeoff import tables_of as points_of
from pipeline.studies.variants import Result, base_of

ROWS = {
    "full": {"psnr": 30.004, "train_s": 10.0, MAIN: True},
    "with # {odd} | name\\": {"psnr": 30.001, "train_s": 9.0, NOTE: "it ~ stopped"},
    "failed": {NOTE: "failed: no & such | file"},
}
TABLE = Table("t", "A & B", "100% of $x$_y", pd.DataFrame.from_dict(ROWS, orient="index"))


def cells_of(text):
    """The cells of a Markdown table, row by row."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def test_markdown_has_a_row_a_line_and_the_best_in_bold():
    head, _, full, odd, failed = cells_of(markdown(TABLE))
    assert head == ["variant", "PSNR ↑", "training s ↓", "note"]
    assert full == ["**full**", "**30.00**", "10", ""]  # what looks equal is equally good
    assert odd == ["with # {odd} \\| name\\\\", "**30.00**", "**9**", "it ~ stopped"]
    assert failed == ["failed", "–", "–", "failed: no & such \\| file"]


def test_a_lone_number_is_not_the_best():
    assert not any(TABLE.best.iloc[2]) and not TABLE.best.isna().any(axis=None)
    alone = Table("t", "", "", TABLE.rows.iloc[:1])
    assert not alone.best.any(axis=None) and "**30.00**" not in markdown(alone)


@settings(deadline=None)
@given(st.text(alphabet=st.sampled_from([*map(chr, LATEX), "a", "B", " ", "7"])))
def test_nothing_is_left_that_latex_takes_for_something_else(text):
    shown = text.translate(LATEX)
    for command in sorted(set(LATEX.values()), key=len, reverse=True):
        if len(command) > 1:
            shown = shown.replace(command, "")
    assert not set(shown) & set("\\&%$#_{}~^<>|↑↓×–²\n")


def test_latex_closes_what_it_opens_and_has_as_many_cells_everywhere():
    text = latex(TABLE)
    for name in ("table", "tabular"):
        assert text.count(rf"\begin{{{name}}}") == text.count(rf"\end{{{name}}}") == 1
    bare = re.sub(r"\\[{}]", "", text)
    assert bare.count("{") == bare.count("}")
    rows = [line for line in text.splitlines() if line.endswith(r" \\")]
    assert len(rows) == 4
    assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {2}
    assert r"\textbf{30.00}" in text and r"with \# \{odd\} \textbar{} name\textbackslash{}" in text
    assert r"no \& such \textbar{} file" in text and text.rstrip().endswith(r"\end{table}")


def test_values_are_in_long_form_without_what_is_not_finite():
    rows = TABLE.values("smile").to_dict("records")
    assert len(rows) == 4
    assert rows[0] == {
        "table": "t", "row": "full", "subject": "smile", "metric": "psnr", "source": "here", "value": 30.004
    }  # fmt: skip


def result(folder, variant, subject="smile", psnr=30.0, avatar="a", seconds=20.0, **metrics):
    """A result with the files that studies read, as the stages would leave them."""
    stages = ("ingest", "fit", "auxiliary", "train", "evaluate")
    folders = {stage: folder / stage for stage in stages}
    folders["train"] = folder / f"train_{subject}_{variant}"
    for path in folders.values():
        path.mkdir(parents=True, exist_ok=True)
    files = [{"path": "avatar.safetensors", "sha256": avatar, "size": 1}]
    (folders["train"] / "manifest.json").write_text(json.dumps({"version": 1, "key": "k", "files": files}))
    timings = {"curve_seconds": [[10, 2.0, 2.0], [20, 4.5, 4.4]]}
    (folders["train"] / "run.json").write_text(json.dumps({"cores": 2, "machine": "x", "timings": timings}))
    means = {"avatar": {"psnr": psnr, "ssim": 0.9, "lpips_alex": 0.05, **metrics}}
    times = {"train": 1.2 * seconds}, {"train": seconds}
    return Result(subject, variant, "", means, *times, folders)


def with_curve(made):
    """The same result, with its curve's file."""
    psnr = made.means["avatar"]["psnr"]
    line = {"iteration": np.array([10, 20], np.int32), "name": np.array(["psnr"] * 2, object)}
    line["value"] = np.array([psnr - 2, psnr], np.float32)
    write_table(made.folders["train"] / "curve.parquet", SCHEMA, line)
    return made


SPEED = {"gaussians": 5000.0, "asset_mib": 0.27, "animation_ms": 20.0, "rendering_ms": 5.0}


def ablation_of(folder, subjects=("smile",), dataset="samples", failing=(), refined=None):
    results = {}
    for subject in subjects:
        for place, key in enumerate([*VARIANTS, CHANCE]):
            same = key in (FULL, "no_views")
            psnr = 29.85 if key == CHANCE else 30 if same else 30 - place / 10
            name = "another seed" if key == CHANCE else VARIANTS[key].name
            results[subject, key] = (
                Result(subject, name, "the clip | is gone")
                if (subject, key) in failing
                else result(folder, name, subject, psnr, "same" if same else key, psnr_face=25.0)
            )
            if refined and not results[subject, key].failure:
                results[subject, key].means["avatar_refined"] = refined
    speeds = {one.folders["train"]: SPEED for one in results.values() if not one.failure}
    scores = score_table(results, speeds, "avatar_refined" if refined else "avatar")
    return ablation.Ablation(scores.rename_axis(["subject", "variant"]), dataset, bool(refined))


def by_name(found):
    return {table.name: table for table in tables_of(found, "Sizes.")}


def test_the_papers_tables_name_known_variants_and_every_variant_has_its_place():
    described = read_toml(ablation.Path(ablation.__file__).with_name("paper.toml"))["tables"]
    assert {row["variant"] for table in described for row in table["rows"]} == {*VARIANTS, CHANCE}
    assert {key for table in described for key in table.get("columns", [])} <= set(METRICS)
    for table in described:
        assert all(len(row["paper"]) == 3 for row in table["rows"] if "paper" in row)


def test_ablation_tables_say_what_is_the_same_and_what_failed(tmp_path):
    tables = by_name(ablation_of(tmp_path, failing=[("smile", "moves")]))
    assert list(tables)[0] == "refinement_and_views" and list(tables)[-1] == "chance"
    rows = tables["refinement_and_views"].rows
    assert rows.loc["full", MAIN] and rows.loc["full", "psnr"] == 30
    assert rows.loc["without generated views", NOTE] == SAME
    assert rows.loc["without refinement (residual colours)", NOTE] == ""
    moved = tables["position_refinement"].rows.iloc[1]
    assert "the clip | is gone" in moved[NOTE] and math.isnan(moved["psnr"])
    runtime = tables["runtime"].rows.iloc[1]
    assert runtime["total_ms"] == 25 and runtime["fps"] == pytest.approx(40)
    faces = tables["face_and_hands"].rows.iloc[0]
    assert faces["psnr_face"] == 25 and math.isnan(faces["psnr_hands"])
    assert set(tables["chance"].rows.index) == {"full", "another seed"}
    assert not tables["chance"].best.any(axis=None)  # neither seed is the better one


def test_a_table_of_which_nothing_was_measured_is_left_out(tmp_path):
    found = ablation_of(tmp_path)
    found.scores.loc[:, [name for name in found.scores if name.endswith(("_face", "_hands"))]] = math.nan
    assert "face_and_hands" not in by_name(found)


def test_refined_poses_count_where_the_protocol_says_so(tmp_path):
    refined = ablation_of(tmp_path, refined={"psnr": 33.0, "ssim": 0.95, "lpips_alex": 0.01})
    assert set(by_name(refined)["refinement_and_views"].rows["psnr"]) == {33.0}
    assert by_name(ablation_of(tmp_path))["refinement_and_views"].rows.loc["full", "psnr"] == 30
    for subject, counts in (("bike", True), ("smile", False)):
        assert counts_refined(base_of(subject, parse_request({}), tmp_path / "log.txt")) == counts


def test_the_papers_figures_stand_beside_the_same_dataset_alone(tmp_path):
    bikes = ablation_of(tmp_path, ("bike", "citron"))

    def table(dataset, name, found=bikes):
        return by_name(dataclasses.replace(found, dataset=dataset))[name]

    beside = table("neuman", "refinement_and_views")
    assert beside.rows["paper psnr"].iloc[1] == 34.90
    assert beside.rows["paper lpips_alex"].iloc[0] == pytest.approx(0.0083)
    assert "paper: PSNR ↑" in markdown(beside) and "0.83" in markdown(beside)
    assert "paper psnr" not in table("insta", "refinement_and_views").rows
    assert table("insta", "visibility_and_fit").rows["paper psnr"].iloc[2] == 31.07
    assert "paper psnr" not in table("insta", "threshold").rows
    biden = ablation_of(tmp_path, ("biden",))
    assert table("insta", "threshold", biden).rows["paper psnr"].iloc[0] == 33.52
    published = table("insta", "runtime").rows.iloc[2:]
    assert list(published["gaussians"]) == [167390, 84095]


def test_means_are_over_the_subjects_that_have_every_row(tmp_path):
    found = ablation_of(tmp_path, ("bike", "citron"), "neuman", failing=[("citron", "moves")])
    found.scores.loc[("bike", FULL), "psnr"] = 40.0
    tables = by_name(found)
    moved = tables["position_refinement"].rows
    assert moved.loc["full", "psnr"] == 40 and all("1 of 2" in note for note in moved[NOTE])
    assert "(citron)" in moved.iloc[1][NOTE]
    assert tables["whole_body"].rows.loc["full", "psnr"] == 35
    assert "1 of 2" not in tables["whole_body"].rows.loc["full", NOTE]
    values = values_of(list(tables.values()), found)
    each = values[values["table"] == "each subject"]
    assert set(each["subject"]) == {"bike", "citron"} and not values["value"].isna().any()
    one = each[(each["subject"] == "bike") & (each["row"] == "full") & (each["metric"] == "psnr")]
    assert list(one["value"]) == [40.0]
    assert set(values[values["source"] == "paper"]["subject"]) == {"mean"}


def test_an_ablation_is_written(tmp_path):
    found = ablation_of(tmp_path, failing=[("smile", "moves")])
    out = tmp_path / "out"
    out.mkdir()
    write_ablation(out, "smile", found, base_of("smile", parse_request({}), out / "log.txt"), 12.0)
    check_page(out / "report.html", pictures=2, tables=len(tables_of(found, "")))
    assert {path.name for path in out.iterdir()} >= {"table.md", "table.tex", "table.parquet"}
    assert len(pd.read_parquet(out / "table.parquet")) > 40
    told = headline(found)
    assert (
        VARIANTS["fixed_threshold"].name.lower() in told.lower() and "-0.90 dB" in told and "2 of 8" in told
    )


DESIGNS = (
    (),
    (Level("iterations", "100 iterations", "400 iterations", {"train.iterations": "400"}),),
    (Level("number of Gaussians", "no subdivision", "one", {"train.subdivisions": "1"}),),
    (Level(CHANCE_PARAMETER, "seed 0", "seed 1", {"train.seed": "1"}),),
)


def tradeoff_of(folder, gains=(0.0, 2.0, 0.4, 0.1), costs=(20.0, 80.0, 30.0, 20.0)):
    designs, speeds = {}, {}
    for number, (design, gain, cost) in enumerate(zip(DESIGNS, gains, costs, strict=True), 1):
        one = designs[design] = result(folder, label_of(design), psnr=30 + gain, seconds=cost)
        speeds[one.folders["train"]] = {
            "gaussians": 5000.0, "animation_ms": 10.0 + number, "rendering_ms": 4.0
        }  # fmt: skip
    designs[DESIGNS[1] + DESIGNS[2]] = Result("smile", "both", "no memory")
    draft = result(folder, "preset draft", psnr=28.0, seconds=10.0, lpips_alex=0.1)
    fits = {"seconds": [1.0, 4.0], "pixels": [3.0, 2.0], "millimetres": [20.0, 12.0]}
    base = base_of("smile", parse_request({}), folder / "log.txt")
    points = point_table(designs, {"draft": draft}, speeds)
    return Tradeoff(base, points, {"balanced": 900.0}, pd.DataFrame(fits, index=[10, 40]), 60.0, 50.0)


def test_one_sentence_says_what_pays(tmp_path):
    told = pays(tradeoff_of(tmp_path))
    assert "from 100 iterations to 400 iterations" in told and "+2.0 dB" in told and "4.0 times" in told
    idle = pays(tradeoff_of(tmp_path, gains=(0.0, 0.05, 0.0, 0.1)))
    assert "0.1 dB" in idle and "5,000 Gaussians" in idle  # nothing is cheaper and as good
    cheaper = pays(tradeoff_of(tmp_path, (0.0, -0.05, -0.3, 0.1), (20.0, 8.0, 4.0, 20.0)))
    assert "400 iterations" in cheaper and "0.4 times" in cheaper and "was 5.0" in cheaper


def test_a_sentence_is_said_of_whatever_the_budget_reached(tmp_path):
    study = tradeoff_of(tmp_path, gains=(0.0, -0.5, -0.4, 0.1))
    for reached in ([1], [1, 2], [1, 2, 3], [1, 4], [1, 5]):
        told = pays(dataclasses.replace(study, points=study.points.loc[reached]))
        assert told.endswith(".") and "nan" not in told


def test_another_seed_is_no_choice(tmp_path):
    study = tradeoff_of(tmp_path, gains=(0.0, 2.0, 0.4, 0.9))
    assert study.noise == pytest.approx(0.9) and study.frontier() == [6, 1, 3, 2]
    assert list(study.points.index[study.points["chance"]]) == [4]
    assert study.points["short"].dropna().tolist() == [0, 0, 0, 0]


def test_a_tradeoff_is_drawn_and_written(tmp_path):
    study = tradeoff_of(tmp_path)
    for made in study.points["result"]:
        if not made.failure:
            with_curve(made)
    points, fits = points_of(study)
    assert points.main == [True, True, True, False, False, True]
    assert "no memory" in points.notes[4] and not any(points.notes[:4])
    assert points.numbers["times"].iloc[1] == 4 and len(fits.rows) == 2
    write_tradeoff(tmp_path, study)
    assert {path.stem for path in tmp_path.glob("*.png")} == {
        "psnr_over_training", "lpips_over_training", "psnr_over_animation", "training_curves",
        "fit_pixels", "fit_millimetres",
    }  # fmt: skip
    assert all(cv2.imread(str(path)).std() > 5 for path in tmp_path.glob("*.png"))
    check_page(tmp_path / "report.html", pictures=6, tables=2)
    assert "preset draft" in (tmp_path / "table.md").read_text()


def test_plots_of_next_to_nothing(tmp_path):
    lone = pd.DataFrame(
        {"x": [5.0, math.nan], "y": [30.0, 1.0], "base": True, "preset": "quick"}, index=[1, 2]
    )
    scatter(tmp_path / "a.png", lone, [1], "s", "dB", {"paper": 500.0, "draft": 2.0})
    scatter(tmp_path / "b.png", lone.iloc[:0], [], "s", "dB", {"paper": 500.0})
    curves(tmp_path / "c.png", {"none": [], "one": [(1.0, 2.0)]}, "s", "dB")
    bars(tmp_path / "d.png", pd.Series({"a": 0.0, "b": math.nan}), "dB", 0.1, True)
    curves(tmp_path / "e.png", {}, "s", "dB")
    assert all(cv2.imread(str(tmp_path / f"{name}.png")) is not None for name in "abcde")


@settings(deadline=None)
@given(st.floats(1e-3, 1e5), st.floats(1.3, 1e5))
def test_a_logarithmic_axis_has_ticks_enough_to_read_it(low, ratio):
    ticks = round_ticks(low, low * ratio)
    assert 2 <= len(ticks) <= 13 and ticks == sorted(ticks)
    assert low <= ticks[0] and ticks[-1] <= low * ratio


def test_equal_plots_have_equal_bytes(tmp_path):
    points = pd.DataFrame({"x": [5.0, 9.0, 9.0], "y": [30.0, 29.0, 29.0]}, index=[1, 2, 3])
    for name in ("a", "b"):
        scatter(tmp_path / f"{name}.png", points, [1], "s", "dB")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


class Reader(html.parser.HTMLParser):
    def __init__(self):
        super().__init__()
        self.open, self.links, self.tags = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "link", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def check_page(path, pictures, tables):
    """Nothing is loaded from anywhere, every tag is closed, pictures and tables are all there."""
    reader = Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    assert not reader.open
    assert reader.links and all(link.startswith("data:") for link in reader.links)
    assert reader.tags.count("img") == pictures and reader.tags.count("thead") == tables
    assert "script" not in reader.tags


def test_aligned_errors_forget_where_bodies_stand():
    rng = np.random.default_rng(0)
    true = rng.normal(size=(4, 55, 3))
    seen = np.zeros((4, 55), bool)
    seen[:, [3, 12, 15]] = True
    moved = true + np.array([0.0, 0.0, 2.0])
    assert aligned_error(moved, true, seen, 12) == pytest.approx(0)
    moved[:, 15] += [0.03, 0, 0]
    assert aligned_error(moved, true, seen, 12) == pytest.approx(0.01)
    assert math.isnan(aligned_error(true, true, np.zeros_like(seen), 12))
