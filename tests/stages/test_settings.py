"""Every setting of every stage: what is out of range, not finite or of another type is refused by name."""

import dataclasses
import math

import pytest

from pipeline.config.settings import Layer, read_fields, resolve, schemas
from pipeline.errors import UserError
from pipeline.run.stage import load_stages
from stages import fit as fit_stage
from stages import ingest as ingest_stage
from stages.fit.settings import FitSettings
from stages.ingest.settings import IngestSettings

KINDS = {name: stage.settings for name, stage in load_stages().items()}
FIELDS = [(stage, field) for stage, kind in KINDS.items() for field in schemas(kind)]
NUMBERS = ("integer", "number")
SIDES = {"minimum": -1, "exclusiveMinimum": -1, "maximum": 1, "exclusiveMaximum": 1}


def options(schema):
    return [option for option in schema.get("anyOf", [schema]) if option["type"] != "null"]


def beyond(schema):
    """(bound, the value just outside it) of each side of a number's range."""
    for side, way in SIDES.items():
        if side in schema:
            bound = schema[side]
            if schema["type"] == "integer":
                yield bound, bound + way
            else:
                yield bound, float(bound) if "exclusive" in side else math.nextafter(bound, way * math.inf)


def wrong_values(schema):
    """Values that a field of one type must refuse."""
    if schema["type"] in NUMBERS:
        words = ["nan", "inf", "-inf", "1e30", "-1e30", "many"]
        return [
            math.nan,
            math.inf,
            -math.inf,
            1e30,
            *words,
            True,
            [1],
            *(value for _, value in beyond(schema)),
        ]
    if schema["type"] == "boolean":
        return ["perhaps", 2, 0.5, "nan"]
    if schema["type"] == "array":
        return [3, math.nan, [3], ["nonsense"] if "enum" in schema["items"] else [[]]]
    words = {"enum": ["nonsense", "", " "], "pattern": ["", " "]}
    return [
        3,
        True,
        math.nan,
        ["a"],
        *(word for kind, wrong in words.items() if kind in schema for word in wrong),
    ]


def refusal(stage, field, value):
    with pytest.raises(UserError) as caught:
        resolve(KINDS, [Layer("here", {stage: {field: value}})])
    return str(caught.value)


@pytest.mark.parametrize(("stage", "field"), FIELDS)
def test_what_a_setting_cannot_be_is_refused_by_name_with_its_range(stage, field):
    schema = schemas(KINDS[stage])[field]
    known = [str(word) for option in options(schema) for word in option.get("enum", ())]
    for option in options(schema):
        for value in wrong_values(option):
            if value in known:  # such as nothing at all
                continue
            message = refusal(stage, field, value)
            assert message.startswith(f"here: {stage}.{field} must be "), message
            assert all(word in message for word in known), message
            assert all(f"{bound:.10g}" in message for bound, _ in beyond(option)), message


@pytest.mark.parametrize(("stage", "field"), FIELDS)
def test_a_setting_has_a_meaning_and_a_number_has_two_bounds_that_it_may_reach(stage, field):
    schema = schemas(KINDS[stage])[field]
    assert schema["description"].strip()
    for option in options(schema):
        if option["type"] in NUMBERS:
            assert len(list(beyond(option))) == 2
            for side in ("minimum", "maximum"):
                if side in option:
                    read_fields(KINDS[stage], {field: option[side]}, "here")
                    read_fields(KINDS[stage], {field: str(option[side])}, "here")


@pytest.mark.parametrize(
    ("stage", "fields", "hint"),
    [
        ("ingest", {"mannequin": "head", "mannequin_motion": "fly"}, "no motion 'fly'"),
        ("fit", {"face": "flame"}, "fit.face=flame needs"),
        ("auxiliary", {"generator": "folder"}, "auxiliary.folder=FOLDER_OR_VIDEO"),
        ("auxiliary", {"generator": "mimicmotion"}, "auxiliary.weights=FOLDER"),
        ("auxiliary", {"overlap": 71}, "auxiliary.overlap must be less than auxiliary.tile"),
        ("train", {"subdivide_from": 1.0}, "train.subdivide_from must be less than 1"),
        ("train", {"groups": 7}, "train.groups must divide train.width, 128"),
        ("train", {"residual_width": 60}, "train.residual_width must be divisible by train.groups"),
        ("animate", {"first_frame": 10, "last_frame": 3}, "10 to 3 is no range"),
        ("animate", {"outputs": []}, "not empty"),
        ("animate", {"width": 33}, "an even whole number"),
        ("animate", {"background": "#12345"}, "text like #00b140"),
        ("animate", {"motion": "nowhere.bvh"}, "no such file"),
        ("animate", {"motion": "subject:"}, "subject:NAME"),
    ],
)
def test_settings_that_do_not_fit_each_other_are_refused(stage, fields, hint):
    with pytest.raises(UserError, match=f"^here: .*{hint}"):
        resolve(KINDS, [Layer("here", {stage: fields})])


@pytest.mark.parametrize(
    ("stage", "field", "text"),
    [("train", "skinning", "foo"), ("train", "generated_every", "0"), ("train", "learning_rate", "inf"),
     ("train", "iterations", "1e10"), ("evaluate", "turntable_fps", "inf"),
     ("auxiliary", "guidance_scale", "nan")],
)  # fmt: skip
def test_what_once_passed_is_refused(stage, field, text):
    assert f"not {text}" in refusal(stage, field, text)


def test_no_subdivision_needs_no_time_for_it():
    assert resolve(KINDS, [Layer("here", {"train": {"subdivide_from": 1, "subdivisions": 0}})])


def test_what_cannot_act_beside_given_detections_and_kept_poses_is_refused():
    given = IngestSettings(keypoints="points", masks="masks", pose_model="heavy")
    assert "pose_model" in ingest_stage.idle(given)
    assert "pose_model" not in ingest_stage.idle(dataclasses.replace(given, masks="auto"))
    assert "lambda_silhouette" in fit_stage.idle(FitSettings(pose_init="poses", given="keep"))
    assert "lambda_silhouette" in fit_stage.idle(FitSettings(iterations=0))
    assert "lambda_silhouette" not in fit_stage.idle(FitSettings())
