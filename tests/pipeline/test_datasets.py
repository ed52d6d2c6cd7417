"""Datasets on the command line: their subjects, their settings, the end of a run, and the paper's table."""

import json

import pytest

from pipeline.config.datasets import Dataset, Row, known_datasets, load_dataset, subjects_of
from pipeline.config.evaluation_protocol import Protocol
from pipeline.config.settings import Layer
from pipeline.config.subjects import load_subject
from pipeline.config.workspace import open_workspace
from pipeline.errors import UserError
from pipeline.run.job import open_job
from pipeline.run.process import make_results
from pipeline.studies.compare import Measured, comparison, wanted


@pytest.fixture
def many(toy):
    for name in ("one", "two"):
        (toy.data / "datasets" / f"{name}.toml").write_text(f'title = "{name}"\n[bend]\nangle = 3.0\n')
    for name, dataset in (("cat", "one"), ("dog", "one"), ("eel", "two")):
        toy.subject(name, f'dataset = "{dataset}"\n[source]\npath = "sources/ann.txt"\n')
    return toy


@pytest.mark.slow
def test_a_dataset_runs_all_its_subjects_with_its_settings(many):
    run = many.doit("dataset=one,two", options=("-n", "2", "-P", "thread"))
    assert run.returncode == 0, run.stderr
    assert sorted(line for line in many.ran() if "paint" in line) == ["paint:cat", "paint:dog", "paint:eel"]
    painted = many.store / "eel" / "paint" / "latest" / "painted.txt"
    assert painted.read_text() == "ann 3.0" * 3
    assert "3 of 3 subjects done, 0 failed" in run.stdout
    again = many.doit("dataset=one", "bend.angle=4")
    assert again.returncode == 0 and "paint:eel" not in many.ran()
    assert "ann 4.0" in (many.store / "cat" / "paint" / "latest" / "painted.txt").read_text()


@pytest.mark.slow
def test_the_end_of_a_run_says_who_failed_where_and_why(many):
    many.subject("dog", 'dataset = "one"\n[source]\npath = "sources/ann.txt"\n[bend]\nfail = "user"\n')
    many.subject("eel", 'dataset = "two"\n[source]\npath = "sources/gone.txt"\n')
    for options in ((), ("-n", "2", "-P", "thread"), ("-n", "2")):
        run = many.doit("dataset=one,two", options=options)
        assert run.returncode != 0
        last = run.stdout.strip().splitlines()[-4:]
        assert last[0] == "1 of 3 subjects done, 2 failed"
        assert last[1] == "  cat  done"
        assert last[2] == "  dog  failed at bend: clip.mp4: is not a clip; name another"
        assert last[3].startswith("  eel  failed at gather:") and "gone.txt" in last[3]
    many.subject("dog", 'dataset = "one"\n[source]\npath = "sources/ann.txt"\n[bend]\nfail = "bug"\n')
    run = many.doit("dataset=one")
    assert "dog  failed at bend: ZeroDivisionError: ours" in run.stdout and "Traceback" in run.stderr


def test_one_subject_needs_no_summary(many):
    assert "subjects done" not in many.doit("subject=cat").stdout


def test_a_dataset_with_a_subject_of_ones_own(many):
    clip = many.root / "clip.txt"
    clip.write_text("me ")
    assert many.doit("subject=me", f"source={clip}", "dataset=one").returncode == 0
    assert "me 3.0" in (many.store / "me" / "paint" / "latest" / "painted.txt").read_text()
    assert many.ran() == ["gather:me", "bend:me", "paint:me"]


def test_an_unknown_dataset_is_one_line(many):
    for words in (("dataset=onee",), ("subject=cat", "dataset=onee")):
        run = many.doit(*words)
        assert run.returncode != 0 and "one" in run.stderr.split("did you mean")[1]
        assert "Traceback" not in run.stderr
    run = many.doit("dataset=pair")
    assert run.returncode != 0 and 'says dataset = "pair"' in run.stderr and "Traceback" not in run.stderr


def rows_of(text):
    """First cell -> the others, of every row of a Markdown table but its rule."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line[:1] == "|"]
    return {row[0]: row[1:] for row in rows if set(row[0]) - set(":-")}


def test_compare_puts_published_rows_beside_ours(many):
    (many.data / "datasets" / "one.toml").write_text(
        'title = "One"\nprotocol = "on white"\n[paper]\ntable = "Table 9"\n'
        '[[paper.rows]]\nmethod = "Theirs"\ncat = [30.0, 0.9, 2.0]\ndog = [20.0, 0.8, 4.0]\n'
        '[[paper.rows]]\nmethod = "Others"\nmean = [31.0, 0.95, 1.5]\n'
    )
    make_results(open_job("cat", many.request()))
    latest = (many.store / "cat" / "paint" / "latest").resolve()
    means = {"avatar": {"psnr": 28.125, "ssim": 0.9, "lpips_alex": 0.0123, "arcface_cosine": None}}
    text = json.dumps({"means": {"test": means}, "protocol": "on black"})
    (latest / "summary.json").write_text(text)
    run = many.doit("compare", "dataset=one")
    assert run.returncode == 0, run.stderr
    assert rows_of(run.stdout) == {
        "method": ["cat", "dog", "mean"],
        "Theirs (published)": ["30.00 / 0.900 / 2.00", "20.00 / 0.800 / 4.00", "25.00 / 0.850 / 3.00"],
        "Others (published)": ["-", "-", "31.00 / 0.950 / 1.50"],
        "**here** (1 of 2 subjects)": ["28.12 / 0.900 / 1.23", "-", "28.12 / 0.900 / 1.23"],
    }
    assert "on white" in run.stdout and "on black" in run.stdout and "Not run: dog" in run.stdout
    written = (many.store / "compare" / "one.md").read_text()
    assert written.strip() in run.stdout
    assert "compare needs a dataset" in many.doit("compare").stdout


def test_the_row_of_the_datasets_own_protocol_is_marked():
    means = {"avatar": {"psnr": 20.0, "ssim": 0.9, "lpips_alex": 0.1}}
    refined = {**means, "avatar_refined": {"psnr": 25.0, "ssim": 0.9, "lpips_alex": 0.1}}
    white = Measured(refined, "white", background="white", render_mask="truth")
    found = {"a": white, "b": Measured(means, "black", current=False)}
    rows = (Row("T", {"b": (1.0, 2.0, 3.0)}),)
    as_neuman = Layer("x", {"evaluate": {"protocol": "paper"}})
    text = comparison(Dataset("x", "X", "", "theirs", as_neuman, "", rows), ["a", "b"], found)
    shown = rows_of(text)
    assert shown["**here, test poses refined** (1 of 2 subjects)"] == ["25.00 / 0.900 / 10.00", "-"] + [
        "25.00 / 0.900 / 10.00"
    ]
    assert shown["here"][0].startswith("20.00") and shown["T (published)"][2] == "-"
    remarks = [line for line in text.splitlines() if line.startswith("- ")]
    assert len([line for line in remarks if "Not comparable" in line and line.endswith(": b")]) == 3
    assert remarks[-1].startswith("- Under other settings") and remarks[-1].endswith(": b")
    plain = Dataset("x", "X", "", "theirs", Layer("x", {"evaluate": {"background": "black"}}), "", rows)
    assert "**here**" in rows_of(comparison(plain, ["a", "b"], found))
    assert "Not comparable" not in comparison(plain, ["b"], {"b": found["b"]})


def test_face_consistency_stands_below_where_it_is_known():
    published = {"Theirs": 0.76}
    about = Dataset("x", "X", "", "", Layer("x", {}), "", (), published)
    plain = {"avatar": {"psnr": 20.0, "ssim": 0.9, "lpips_alex": 0.1}}
    with_face = {"avatar": {**plain["avatar"], "arcface_cosine": 0.5}}
    unmeasured = comparison(about, ["a", "b"], {"a": Measured(plain)})
    assert rows_of(unmeasured)["Theirs (published)"] == ["0.7600"] and "evaluate.arcface" in unmeasured
    below = comparison(about, ["a", "b"], {"a": Measured(with_face)}).split("## ")[1]
    assert rows_of(below)["here (1 of 2 subjects)"] == ["0.5000", "0.5000"]
    assert rows_of(below)["Theirs (published)"] == ["-", "0.7600"] and "evaluate.arcface" not in below
    nothing = Dataset("x", "X", "", "", Layer("x", {}), "", ())
    assert "## " not in comparison(nothing, ["a"], {"a": Measured(plain)})
    assert load_dataset(open_workspace(), "neuman").faces["FlexiAvatar"] == 0.7903  # Table A3


def test_datasets_are_judged_as_the_paper_does():
    workspace = open_workspace()
    others = ("talkshow", "zju", "insta", "wildavatar")
    assert wanted(load_dataset(workspace, "neuman")) == Protocol("white", "truth", "on", "photograph")
    found = {wanted(load_dataset(workspace, name)) for name in others}
    assert found == {Protocol("black", "truth", "off", "photograph")}


def test_a_dataset_without_published_numbers_has_a_table_too():
    about = Dataset("x", "X", "", "", Layer("x", {}), "", ())
    means = {"avatar": {"psnr": 20.0}}
    found = {"a": Measured(means)}
    shown = rows_of(comparison(about, ["a", "b"], found))
    assert shown["method"] == ["a", "mean"] and shown["**here** (1 of 2 subjects)"][0] == "20.00 / - / -"
    with_rows = Dataset("x", "X", "", "", Layer("x", {}), "", (Row("T", {"b": (1.0, 2.0, 3.0)}),))
    assert rows_of(comparison(with_rows, ["a", "b"], found))["method"] == ["a", "b", "mean"]
    assert rows_of(comparison(with_rows, ["a", "b"], {}))["method"] == ["b", "mean"]


def test_the_papers_datasets_are_complete():
    workspace = open_workspace()
    counts = {"insta": 7, "neuman": 4, "samples": 3, "talkshow": 3, "wildavatar": 7, "zju": 6}
    assert {name: len(subjects_of(workspace, name)) for name in known_datasets(workspace)} == counts
    for name in counts:
        about = load_dataset(workspace, name)
        subjects = {*subjects_of(workspace, name), "mean"}
        assert all(set(row.values) <= subjects for row in about.rows)
        assert name == "samples" or (about.protocol and about.rows and about.obtain)
    assert load_subject(workspace, "bala").obtain.startswith("take the actors")


def test_a_row_that_is_no_row_names_its_file(tmp_path):
    (tmp_path / "datasets").mkdir()
    (tmp_path / "datasets" / "bad.toml").write_text('[[paper.rows]]\nmethod = "x"\nmean = [1.0]\n')
    with pytest.raises(UserError, match=r"bad\.toml"):
        load_dataset(open_workspace(data=tmp_path), "bad")
