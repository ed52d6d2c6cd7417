"""The plan stage: what it measures, what it decides, and that every decision can be overridden."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.body import PARTS
from pipeline.clip.camera import facing_camera
from pipeline.clip.keypoints import FACE, empty_keypoints, write_keypoints
from pipeline.clip.plan import DECIDED, EFFECTS, SEEN_PARTS, read_plan
from pipeline.clip.records import Split, read_footage, write_footage, write_split
from pipeline.config.settings import command_line_layer, resolve
from pipeline.errors import UserError
from pipeline.files.json_files import write_json
from pipeline.files.tables import write_table
from stages.ingest.cameras.background_motion import MOVING
from stages.plan import decide, measure
from stages.plan.run import run
from stages.plan.settings import PlanSettings
from tests.made.body import open_body
from tests.made.context import stage_context
from tests.made.portrait import FRAMES, write_subject

AZIMUTH_CASES = [
    ((), 360.0, 12),
    ((0.0,), 330.0, 11),
    (tuple(range(0, 360, 30)), 0.0, 0),
    ((0.0, 180.0), 150.0, 10),
    ((-20.0, 20.0), 270.0, 10),
]


def write_planned(folder):
    """Six frames of a head whose mouth opens, as ingest and fit would publish them."""
    write_subject(folder)
    keypoints = empty_keypoints(np.arange(FRAMES))
    places = np.random.default_rng(0).uniform(8, 40, (68, 2))
    for row in range(FRAMES):
        keypoints.whole_body[row, FACE, :2] = places
        keypoints.whole_body[row, FACE, 2] = 0.9
        keypoints.whole_body[row, 71:91, 1] += 6 * np.sin(row / 2)
    write_keypoints(folder / "ingest" / "keypoints.parquet", keypoints)
    columns = {"frame": np.arange(FRAMES, dtype=np.int32), "pixels": np.full(FRAMES, 0.8, np.float32)}
    write_table(folder / "fit" / "residuals.parquet", measure.RESIDUALS, columns)
    write_json(folder / "fit" / "face.json", {"source": "auto", "frames": 6, "registered": 5})


@pytest.fixture
def clip(tmp_path):
    """The head's folders, which a test may change."""
    write_planned(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """What is measured of the head."""
    folder = tmp_path_factory.mktemp("head")
    write_planned(folder)
    return measure.read_inputs(folder / "ingest", folder / "fit", open_body())


@pytest.fixture(scope="module")
def usual(inputs):
    """Its plan, nothing overridden."""
    return decide.decide(inputs, PlanSettings())


def context_of(clip, **settings):
    inputs = {name: clip / name for name in ("ingest", "fit")}
    return stage_context("plan", PlanSettings(**settings), clip / "out", inputs)


def planned(clip, **settings):
    context = context_of(clip, **settings)
    run(context)
    return read_plan(context.output / "plan.json")


def test_a_head_calls_for_what_a_head_has(usual):
    plan = usual
    on = {name for name in EFFECTS if plan.on(name)}
    assert {"face_registration", "face_residual", "face_loss", "visibility_gate"} <= on
    assert {"auxiliary_views", "pose_refinement", "pose_heads", "seen_head", "seen_face"} <= on
    off = {"structure_from_motion", "test_time_refinement", "left_hand_residual", "right_hand_residual"}
    assert not on & {*off, "seen_left_leg", "seen_right_leg", "seen_left_hand"}
    assert not any(one.forced for one in plan.decisions)
    assert 180.0 in plan["auxiliary_views"].values and 0.0 not in plan["auxiliary_views"].values
    assert plan["face_registration"].measured == 5 and plan["pose_refinement"].measured == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("pixels", "levels"), [(0.0, 0), (0.7, 0), (1.5, 0), (1.6, 1), (3.0, 1), (3.1, 2), (6.1, 3)]
)
def test_gaussians_are_as_fine_as_the_pixels(inputs, monkeypatch, pixels, levels):
    monkeypatch.setattr(decide, "gaussian_pixels", lambda inputs: pixels)
    made = decide.subdivision(inputs)
    assert made.on == (levels > 0) and made.values == (levels,) and made.measured == pixels


def test_pixels_between_vertices_are_those_of_a_known_grid():
    step = torch.arange(11) * 0.02  # metres
    grid = torch.stack([*torch.meshgrid(step, step, indexing="xy"), torch.full((11, 11), -2.0)], -1)
    corner = torch.arange(110).reshape(10, 11)[:, :10].flatten()
    quads = torch.stack([corner, corner + 1, corner + 12, corner, corner + 12, corner + 11], 1)
    faces = quads.reshape(-1, 3)  # round to the left seen from +Z, where the camera stands
    camera = facing_camera(400, 400, 300.0)
    grid = grid.reshape(-1, 3)
    assert measure.vertex_spacing(grid, faces, camera) == pytest.approx(300 * 0.02 / 2, rel=1e-5)
    assert measure.vertex_spacing(grid, faces.flip(1), camera) == 0  # turned away
    behind = grid * torch.tensor([1.0, 1.0, -1.0])
    assert measure.vertex_spacing(behind, faces, camera) == 0
    assert measure.vertex_spacing(grid + 5, faces, camera) == 0  # outside of the picture


def test_a_picture_of_half_the_size_halves_the_pixels_between_vertices(inputs):
    half = {frame: one.resized(one.width // 2, one.height // 2) for frame, one in inputs.cameras.items()}
    smaller = dataclasses.replace(inputs, cameras=half)
    ratio = measure.gaussian_pixels(inputs) / measure.gaussian_pixels(smaller)
    assert ratio == pytest.approx(2, rel=0.02)


def test_finer_edges_call_for_more_gaussians_and_training_is_told_how_fine(inputs):
    coarse, fine = (
        decide.decide(inputs, PlanSettings(edge_pixels=edge))["gaussians"] for edge in (100.0, 0.7)
    )
    assert fine.threshold == 0.7 and sum(fine.values) > 2 * sum(coarse.values) > 0
    legs = [PARTS.index(part) for part in ("left_leg", "right_leg")]
    assert not any(fine.values[place] for place in legs)  # no frame shows them


@pytest.mark.parametrize(("frames", "steps"), [(1, 400), (65, 500), (260, 1000), (5000, 1000)])
def test_more_frames_get_more_steps_within_limits(frames, steps):
    clip = SimpleNamespace(split=Split(train=tuple(range(frames)), test=()))
    assert decide.steps(SimpleNamespace(clip=clip)).values == (steps,)


def test_equal_inputs_give_equal_bytes(clip):
    planned(clip)
    first = (clip / "out" / "plan.json").read_bytes()
    planned(clip)
    assert (clip / "out" / "plan.json").read_bytes() == first


def test_what_is_set_and_not_decided_is_named_in_the_log(clip):
    def naming(**settings):
        context = context_of(clip, **settings)
        run(context)
        return [line for line in context.logged if "face loss" in line and "plan.json" in line]

    assert len(naming(face_loss="on")) == 1 and not naming()


@pytest.mark.parametrize("effect", [*DECIDED, *SEEN_PARTS])
def test_any_decision_is_overridden_from_the_command_line(inputs, usual, effect):
    choice = "off" if usual.on(effect) else "on"
    words = command_line_layer({f"plan.{effect}": choice})
    settings = resolve({"plan": PlanSettings}, [words])["plan"]
    made = decide.decide(inputs, settings)[effect]
    assert made.on != usual.on(effect) and made.forced and made.measured == usual[effect].measured
    assert f"plan.{effect}={choice}" in made.why and usual[effect].why in made.why


def test_a_part_that_is_said_to_be_unseen_gets_no_residual(inputs):
    plan = decide.decide(inputs, PlanSettings(seen_face="off"))
    assert not plan.on("face_residual") and not plan["face_residual"].forced
    assert decide.decide(inputs, PlanSettings(seen_face="off", face_residual="on")).on("face_residual")


def test_what_ingest_and_fit_were_told_counts_as_set(clip):
    write_json(clip / "fit" / "face.json", {"source": "off", "frames": 6, "registered": 0})
    footage = read_footage(clip / "ingest" / "footage.json")
    for camera, on, forced in (
        ({"source": "sfm", "displacement": 0.07}, True, False),
        ({"source": "pinhole", "displacement": 0.001}, False, False),
        ({"source": "pinhole", "displacement": 0.07}, False, True),
        ({"source": "sfm", "displacement": None}, True, True),
    ):
        write_footage(clip / "ingest" / "footage.json", dataclasses.replace(footage, camera=camera))
        plan = planned(clip)
        made = plan["structure_from_motion"]
        assert (made.on, made.forced) == (on, forced)
    assert plan["face_registration"].forced and not plan.on("face_loss")


def test_one_training_frame_gives_a_plan(clip):
    write_split(clip / "ingest" / "split.json", Split((2,), (5,)))
    plan = planned(clip)
    assert not plan.on("pose_heads") and plan.on("visibility_gate")
    assert len(plan["auxiliary_views"].values) == 11


def test_there_is_a_setting_for_each_decision():
    choices = {field.name for field in dataclasses.fields(PlanSettings) if field.type == "Choice"}
    assert choices == {*DECIDED, *SEEN_PARTS}


def test_numbers_that_stand_in_two_places_agree():
    assert decide.BACKGROUND_MOTION == MOVING


@pytest.mark.parametrize(("degrees", "widest", "count"), AZIMUTH_CASES)
def test_azimuths_that_no_frame_shows(inputs, degrees, widest, count):
    whole = inputs.clip
    poses = whole.poses
    rotation = poses.rotation[:1].repeat(max(1, len(degrees)), 1, 1)
    for row, angle in enumerate(degrees):  # the body turned away by an angle is seen from minus that
        rotation[row, 0] = torch.tensor([0.0, -np.deg2rad(angle), 0.0])
    frames = tuple(range(len(rotation)))
    transl = torch.tensor([0.0, 0.0, -3.0]).repeat(len(frames), 1)
    turned = dataclasses.replace(
        poses, frames=frames, rotation=rotation, transl=transl,
        expression=poses.expression[:1].repeat(len(frames), 1), valid=None,
    )  # fmt: skip
    camera = whole.cameras[0]
    changed = dataclasses.replace(
        whole, poses=turned, cameras=dict.fromkeys(frames, camera),
        split=Split(frames if degrees else (), ()),
    )  # fmt: skip
    found, unseen = measure.unseen_azimuths(changed, torch.zeros(55, 3))
    assert (found, len(unseen)) == (widest, count)
    for angle in degrees:
        assert (30.0 * round(angle / 30)) % 360 not in unseen


@pytest.mark.parametrize("name", ["fit/face.json", "fit/residuals.parquet", "ingest/keypoints.parquet"])
def test_a_missing_file_is_named(clip, name):
    (clip / name).unlink()
    with pytest.raises(UserError, match=name.split("/")[1]):
        planned(clip)


def test_a_frame_without_a_pose_is_named(clip):
    write_split(clip / "ingest" / "split.json", Split((0, 1, 9), ()))
    with pytest.raises(UserError, match="frame 9"):
        planned(clip)
