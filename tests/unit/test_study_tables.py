"""A study's tables, plots and page."""

import dataclasses
import html.parser
import json
import math
import re

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.settings import read_toml
from pipeline.studies import ablation
from pipeline.studies.ablation import CHANCE, FULL, SAME, VARIANTS, Results, parquet_values, tables_of
from pipeline.studies.ablation_report import headline, write_ablation
from pipeline.studies.design import words_of
from pipeline.studies.fits import FitPoint, aligned_error
from pipeline.studies.knobs import CHANCE as CHANCE_KNOB
from pipeline.studies.knobs import Knob, Level
from pipeline.studies.plots import Axis, Dot, bars, curves, scatter
from pipeline.studies.run import Failure
from pipeline.studies.tables import ESCAPES, HERE, PAPER, Column, Row, Table, escaped, latex, markdown
from pipeline.studies.tradeoff import Entry, Study, sentence
from pipeline.studies.tradeoff_report import page, plots
from pipeline.studies.tradeoff_report import tables_of as points_of
from pipeline.study import Outcome
from pipeline.tables import write_table

METRIC = Column("psnr", "PSNR", 2, "higher")
SECONDS = Column("s", "time | s", 0, "lower")
TABLE = Table(
    "t", "A & B", "100% of $x$_y", (METRIC, SECONDS),
    (
        Row("full", {("psnr", HERE): 30.004, ("s", HERE): 10.0}, main=True),
        Row("with # {odd} | name\\", {("psnr", HERE): 30.001, ("s", HERE): 9.0}, "it ~ stopped"),
        Row("failed", {("psnr", HERE): math.nan}, "failed: no & such file"),
    ),
)  # fmt: skip


def test_markdown_has_a_row_a_line_and_the_best_in_bold():
    lines = markdown(TABLE).splitlines()
    rows = [line for line in lines if line.startswith("|")]
    assert rows[0] == "| variant | PSNR ↑ | time \\| s ↓ | note |"
    cells = [re.split(r"(?<!\\)\|", row)[1:-1] for row in rows]
    assert {len(row) for row in cells} == {4}
    assert cells[2][1].strip() == cells[3][1].strip() == "**30.00**"  # what looks equal is equally good
    assert (cells[2][2].strip(), cells[3][2].strip()) == ("10", "**9**")
    assert [cell.strip() for cell in cells[4][1:3]] == ["–", "–"]
    assert "failed: no & such file" in rows[4]


@given(st.text(alphabet=st.sampled_from([*ESCAPES, "a", "B", " ", "7"])))
def test_nothing_is_left_that_latex_takes_for_something_else(text):
    shown = escaped(text)
    for command in sorted({value for value in ESCAPES.values()}, key=len, reverse=True):
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


def outcome(folder, variant, subject="smile", psnr=30.0, avatar="a", seconds=20.0, **metrics):
    """As evaluate would leave it, with the files that studies read."""
    folders = {}
    for stage in ("ingest", "fit", "auxiliary", "train", "evaluate"):
        folders[stage] = folder / f"{stage}_{subject}_{variant}" if stage == "train" else folder / stage
        folders[stage].mkdir(parents=True, exist_ok=True)
        files = [{"path": "avatar.safetensors", "sha256": avatar}]
        (folders[stage] / "manifest.json").write_text(json.dumps({"version": 1, "files": files}))
    timings = {"curve_seconds": [[10, 2.0, 2.0], [20, 4.5, 4.4]]}
    (folders["train"] / "run.json").write_text(json.dumps({"cores": 2, "machine": "x", "timings": timings}))
    from pipeline.curves import SCHEMA

    line = {"iteration": np.array([10, 20], np.int32), "name": np.array(["psnr"] * 2, object)}
    write_table(
        folders["train"] / "curve.parquet", SCHEMA, line | {"value": np.array([psnr - 2, psnr], np.float32)}
    )
    means = {"test": {"avatar": {"psnr": psnr, "ssim": 0.9, "lpips_alex": 0.05, **metrics}}}
    return Outcome(subject, variant, means, 5000, {"train": 1.2 * seconds}, {"train": seconds}, folders)


def results(folder, subjects=("smile",), dataset="samples", failing=()):
    endings = {}
    for subject in subjects:
        for place, key in enumerate([*VARIANTS, CHANCE]):
            same = key in (FULL, "no_views")
            endings[subject, key] = (
                Failure(subject, key, "the clip | is gone")
                if (subject, key) in failing
                else outcome(
                    folder, key, subject, {CHANCE: 29.85}.get(key, 30 if same else 30 - place / 10),
                    "same" if same else key, psnr_face=25.0, psnr_hands=None,
                )
            )  # fmt: skip
    speed = {"gaussians": 5000.0, "asset_mib": 0.27, "animation_ms": 20.0, "rendering_ms": 5.0}
    return Results(tuple(subjects), endings, dict.fromkeys(endings, speed), dataset)


def test_the_papers_tables_name_known_variants_and_every_variant_has_its_place():
    described = read_toml(ablation.Path(ablation.__file__).with_name("paper.toml"))["tables"]
    assert [
        row["variant"] for table in described for row in table["rows"] if row["variant"] not in VARIANTS
    ] == []
    assert {row["variant"] for table in described for row in table["rows"]} == set(VARIANTS)
    for table in described:
        assert all(len(row["paper"]) == 3 for row in table["rows"] if "paper" in row)


def test_ablation_tables_say_what_is_the_same_and_what_failed(tmp_path):
    tables = {
        table.name: table for table in tables_of(results(tmp_path, failing=[("smile", "moves")]), "Sizes.")
    }
    assert list(tables)[0] == "refinement_and_views" and list(tables)[-1] == "chance"
    rows = {row.label: row for row in tables["refinement_and_views"].rows}
    assert rows["full"].main and rows["full"].values["psnr", HERE] == 30
    assert rows["without generated views"].note == SAME
    assert rows["without refinement (residual colours)"].note == ""
    moved = tables["position_refinement"].rows[1]
    assert "failed: the clip | is gone" in moved.note and math.isnan(moved.values["psnr", HERE])
    runtime = tables["runtime"].rows[1].values
    assert runtime["total_ms", HERE] == 25 and runtime["fps", HERE] == pytest.approx(40)
    faces = tables["face_and_hands"].rows[0].values
    assert faces["psnr_face", HERE] == 25 and math.isnan(faces["psnr_hands", HERE])
    assert all("Sizes. Another seed differs by 0.15 dB." in table.caption for table in tables.values())


def test_what_evaluate_did_not_measure_has_no_table(tmp_path):
    found = results(tmp_path)
    bare = {key: outcome(tmp_path, key[1], psnr=30.0) for key in found.endings}
    names = [table.name for table in tables_of(dataclasses.replace(found, endings=bare), "")]
    assert "face_and_hands" not in names and {"runtime", "whole_body", "chance"} <= set(names)


def test_refined_poses_count_where_the_protocol_says_so(tmp_path):
    found = results(tmp_path)
    for one in found.endings.values():
        one.means["test"]["avatar_refined"] = {"psnr": 33.0, "ssim": 0.95, "lpips_alex": 0.01}
    refined = tables_of(dataclasses.replace(found, refined=True), "")[0]
    assert {row.values["psnr", HERE] for row in refined.rows} == {33.0} and "poses refined" in refined.caption
    assert tables_of(found, "")[0].rows[0].values["psnr", HERE] == 30
    assert ablation.counts_refined("bike", {}) and not ablation.counts_refined("smile", {})


def test_the_papers_figures_stand_beside_the_same_dataset_alone(tmp_path):
    def sources(dataset, name, subjects=("bike", "citron")):
        found = results(tmp_path, subjects, dataset)
        return next(table for table in tables_of(found, "") if table.name == name)

    beside = sources("neuman", "refinement_and_views")
    assert beside.rows[1].values["psnr", PAPER] == 34.90
    assert beside.rows[0].values["lpips_alex", PAPER] == pytest.approx(0.0083)
    assert "paper: PSNR ↑" in markdown(beside) and "0.83" in markdown(beside)
    assert not any(column.source == PAPER for column in sources("insta", "refinement_and_views").columns)
    assert sources("insta", "visibility_and_fit").rows[2].values["psnr", PAPER] == 31.07
    assert not any(column.source == PAPER for column in sources("insta", "threshold").columns)
    assert sources("insta", "threshold", ("biden",)).rows[0].values["psnr", PAPER] == 33.52
    labels = [row.label for row in sources("insta", "runtime").rows]
    assert labels[2:] == ["ExAvatar, head (published)", "FlexiAvatar, head (published)"]


def test_means_are_over_the_subjects_that_have_every_row(tmp_path):
    found = results(tmp_path, ("bike", "citron"), "neuman", failing=[("citron", "moves")])
    tables = {table.name: table for table in tables_of(found, "")}
    assert all("mean of 1 of 2 subjects" in row.note for row in tables["position_refinement"].rows)
    assert "failed (citron)" in tables["position_refinement"].rows[1].note
    assert "mean of" not in tables["whole_body"].rows[0].note
    values = parquet_values(list(tables.values()), found)
    assert {one.subject for one in values if one.table == "each subject"} == {"bike", "citron"}


def test_an_ablation_is_written(tmp_path):
    found = results(tmp_path, failing=[("smile", "moves")])
    (tmp_path / "out").mkdir()
    tables = tables_of(found, "Sizes.")
    write_ablation(tmp_path / "out", "smile", found, tables, {"torch": "2"}, 12.0, {})
    check_page(tmp_path / "out" / "report.html", pictures=2, tables=len(tables))
    assert headline(found).startswith(
        "Fixed threshold 0.4 costs most: -0.80 dB; 2 of 7 variants differ by no more"
    )


KNOBS = (
    Knob("iterations", (Level("100 iterations"), Level("400 iterations", {"train.iterations": "400"}))),
    Knob("number of Gaussians", (Level("no subdivision"), Level("one", {"train.subdivisions": "1"}))),
    Knob(CHANCE_KNOB, (Level("seed 0"), Level("seed 1", {"train.seed": "1"})), False),
)


def study(folder, gains=(0.0, 2.0, 0.4, 0.1), costs=(20.0, 80.0, 30.0, 20.0)):
    points = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    entries = []
    for number, (point, gain, cost) in enumerate(zip(points, gains, costs, strict=True), 1):
        made = outcome(folder, f"point{number}", psnr=30 + gain, seconds=cost)
        speed = {"gaussians": 5000.0, "animation_ms": 10.0 + number, "rendering_ms": 4.0}
        quality = made.means["test"]["avatar"]
        words = words_of(KNOBS, point)
        entries.append(Entry(number, f"point {number}", words, made, "", quality, speed, cost, point))
    failed = Entry(5, "point 5", {}, None, "no memory", {}, {}, math.nan, (1, 1, 0))
    fits = [FitPoint(10, 1.0, "processor", 3.0, 20.0), FitPoint(40, 4.0, "processor", 2.0, 12.0)]
    return Study("smile", {}, KNOBS, [*entries, failed], {"balanced": 900.0}, fits, 60.0, 50.0)


def test_one_sentence_says_what_pays(tmp_path):
    told = sentence(study(tmp_path))
    assert "from 5,000 Gaussians" in told or "100 iterations to 400 iterations" in told
    assert "+2.0 dB" in told and "4.0 times the training time" in told
    idle = sentence(study(tmp_path, gains=(0.0, 0.05, 0.0, 0.1)))
    assert "No single change that was tried gains more than another seed does (0.1 dB)" in idle
    assert idle.endswith("stay with 5,000 Gaussians and 100 iterations.")  # nothing is cheaper


def test_what_is_cheaper_and_as_good_is_named_with_its_price(tmp_path):
    told = sentence(study(tmp_path, gains=(0.0, -0.05, -0.3, 0.1), costs=(20.0, 8.0, 4.0, 20.0)))
    assert told.endswith(
        "point 2, at 0.4 times the training time, does as well in PSNR (LPIPS×100 5.0, was 5.0)."
    )


def test_a_tradeoff_is_drawn_and_written(tmp_path):
    found = study(tmp_path)
    pictures = plots(tmp_path, found)
    assert [picture.path.name for picture in pictures] == [
        "psnr_over_training.png", "lpips_over_training.png", "psnr_over_animation.png", "training_curves.png",
        "fit_pixels.png", "fit_millimetres.png",
    ]  # fmt: skip
    for picture in pictures:
        assert cv2.imread(str(picture.path)).std() > 5
    tables = points_of(found)
    assert [row.main for row in tables[0].rows] == [True, True, True, False, False]
    assert "failed: no memory" in tables[0].rows[4].note
    from pipeline.studies.page import write_page

    write_page(tmp_path / "report.html", page(found, tables, pictures))
    check_page(tmp_path / "report.html", pictures=6, tables=2)


def test_plots_of_next_to_nothing(tmp_path):
    lone = [Dot(1, 5.0, 30.0, True, True, "quick"), Dot(2, math.nan, 1.0)]
    scatter(tmp_path / "a.png", lone, Axis("s", log=True), Axis("dB"), {"paper": 500.0})
    scatter(tmp_path / "b.png", [], Axis("s"), Axis("dB"))
    curves(tmp_path / "c.png", {"none": [], "one": [(1.0, 2.0)]}, Axis("s"), Axis("dB"))
    bars(tmp_path / "d.png", {"a": 0.0, "b": math.nan}, "dB", 0.1)
    assert all(cv2.imread(str(tmp_path / f"{name}.png")) is not None for name in "abcd")


def test_equal_plots_have_equal_bytes(tmp_path):
    dots = [Dot(1, 5.0, 30.0, True), Dot(2, 9.0, 29.0)]
    for name in ("a", "b"):
        scatter(tmp_path / f"{name}.png", dots, Axis("s", log=True), Axis("dB"))
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


def test_values_are_read_back(tmp_path):
    from pipeline.studies.tables import values_of, write_values

    write_values(tmp_path / "table.parquet", values_of(TABLE, "smile"))
    rows = pq.read_table(tmp_path / "table.parquet").to_pylist()
    assert len(rows) == 4  # what is not finite has no row
    assert rows[0] == {
        "table": "t", "row": "full", "subject": "smile", "metric": "psnr", "source": "here", "value": 30.004
    }  # fmt: skip
