"""Poses that a dataset came with, through the fit stage: kept as they are, started from, or ignored."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from pipeline.body import mean_identity, pose_body, read_identity, read_poses
from pipeline.clip.camera import Camera
from pipeline.errors import UserError
from pipeline.pose_files import (
    INITIAL_POSES,
    InitialPoses,
    read_hand_mean,
    read_initial_poses,
    with_flat_hands,
    write_initial_poses,
    write_peer_files,
)
from stages.fit.initialise_from_poses import given_identity
from stages.fit.run import run
from stages.fit.settings import FitSettings
from stages.ingest.run import run as run_ingest
from stages.plan.decide import decide, face_registration
from stages.plan.measure import read_inputs
from stages.plan.settings import PlanSettings
from stages.train.settings import TrainSettings, apply_plan
from tests.made import layouts as writers
from tests.made.body import BODY_FILE
from tests.made.context import stage_context
from tests.made.fake_body import write_official
from tests.made.layout_footage import COUNT, SIZE, footage
from tests.made.videos import ingest_context


@pytest.fixture(scope="module")
def shown():
    return footage()


@pytest.fixture(scope="module")
def ingested(shown, tmp_path_factory):
    folder = tmp_path_factory.mktemp("prepared")
    every = list(range(COUNT))
    source = writers.prepared(folder / "me", shown, {"all": every, "train": every[:4], "test": every[4:]})
    context = ingest_context(folder / "run", source)
    run_ingest(context)
    return context.output


def fit(folder, ingested, **settings):
    context = stage_context("fit", FitSettings(**settings), folder / "output", {"ingest": ingested})
    run(context)
    return context.output


def surface_error(shown, output):
    """How far vertices are from the truth, mean over frames and vertices, metres."""
    poses, identity = (
        read_poses(output / "poses.parquet"),
        read_identity(output / "identity.safetensors", shown.body),
    )
    found, _ = pose_body(shown.body, identity, poses.rotation, poses.expression, poses.transl)
    truth = shown.poses
    true, _ = pose_body(shown.body, shown.identity, truth.rotation, truth.expression, truth.transl)
    return float((found - true).norm(dim=-1).mean())


def test_a_fitted_folder_is_published_as_it_is_and_training_can_begin(tmp_path, shown, ingested):
    output = fit(tmp_path, ingested, given="keep")
    # What is left are the float32 of poses and cameras.
    assert surface_error(shown, output) < 1e-4
    names = {path.name for path in output.iterdir()}
    assert {
        "fit_quality.parquet",
        "identity.safetensors",
        "poses.parquet",
        "template.ply",
        "overlay.mp4",
        "residuals.parquet",
    } <= names
    raw = read_poses(output / "poses_raw.parquet")
    assert torch.equal(raw.rotation, read_poses(output / "poses.parquet").rotation)  # not smoothed again


def test_the_fit_starts_from_them(tmp_path, shown, ingested):
    """Without steps the start is published: it is the files', and not the estimator's."""
    started = fit(tmp_path / "start", ingested, given="start", iterations=0, smoothing_seconds=0.0)
    only_start = {"iterations": 0, "smoothing_seconds": 0.0, "accept": "any"}
    ignored = fit(tmp_path / "ignore", ingested, given="ignore", **only_start)
    wanted = shown.poses.rotation
    for output, near in ((started, True), (ignored, False)):
        found = read_poses(output / "poses.parquet").rotation
        difference = (found - wanted)[:, 1:22].norm(dim=-1).mean()
        assert bool(difference < 0.02) == near


def test_what_is_not_there_or_anothers_cannot_be_kept(tmp_path, ingested):
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in ingested.iterdir():
        if path.name != INITIAL_POSES:
            (bare / path.name).symlink_to(path)
    with pytest.raises(UserError, match="no poses to keep"):
        fit(tmp_path / "none", bare, given="keep")
    record = read_initial_poses(ingested / INITIAL_POSES)
    write_initial_poses(bare / INITIAL_POSES, dataclasses.replace(record, model="smplx"))
    with pytest.raises(UserError, match="SMPLX_NEUTRAL"):
        fit(tmp_path / "other", bare, given="keep")
    write_initial_poses(bare / INITIAL_POSES, dataclasses.replace(record, transl=None))
    with pytest.raises(UserError, match="no place"):
        fit(tmp_path / "placeless", bare, given="keep")


def test_our_own_fit_goes_out_and_comes_back(tmp_path, shown):
    """What fit.export_peers writes, with frames beside it, is a prepared folder."""
    still = shown.still
    cameras = {
        row: Camera(
            SIZE, SIZE, *(torch.from_numpy(a).float() for a in (still.matrix, still.rotation[row], shift))
        )
        for row, shift in enumerate(still.translation)
    }
    folder = tmp_path / "me"
    mean = read_hand_mean(BODY_FILE)
    write_peer_files(folder, shown.body, shown.identity, shown.poses, shown.poses, cameras, mean)
    every = range(COUNT)
    writers.pictures(folder / "frames", still.images, [f"{row}.png" for row in every])
    writers.pictures(folder / "masks", still.masks, [f"{row}.png" for row in every])
    writers.keypoint_files(folder / "keypoints_whole_body", still.keypoints, every)
    context = ingest_context(tmp_path / "run", folder)
    run_ingest(context)
    assert surface_error(shown, fit(tmp_path / "fit", context.output, given="keep")) < 1e-4


def pca_poses(coefficients):
    return InitialPoses(
        frames=(0, 1), rotation=torch.zeros(2, 55, 3), expression=None, betas=None, transl=None,
        valid=torch.ones(2, dtype=torch.bool), hands="mean", hand_pca=coefficients,
    )  # fmt: skip


def test_hand_coefficients_need_the_users_smplx_file(tmp_path):
    rng = np.random.default_rng(0)
    path = write_official(tmp_path / "SMPLX_NEUTRAL.npz")
    with np.load(path) as archive:
        arrays = dict(archive)
    components = rng.normal(size=(2, 45, 45))
    means = rng.normal(size=(2, 45)) * 0.1
    arrays |= {"hands_componentsl": components[0], "hands_componentsr": components[1]}
    arrays |= {"hands_meanl": means[0], "hands_meanr": means[1]}
    np.savez(path, **arrays)
    coefficients = torch.from_numpy(rng.normal(size=(2, 2, 12)))
    notes = []
    found = with_flat_hands(pca_poses(coefficients), path, True, notes.append)
    expected = means[None] + np.einsum("tsp,spk->tsk", coefficients.numpy(), components[:, :12])
    np.testing.assert_allclose(found.rotation[:, 25:].numpy(), expected.reshape(2, 30, 3), atol=1e-5)
    assert not notes and not found.rotation[:, :25].any()
    relaxed = with_flat_hands(pca_poses(coefficients), path, False, notes.append)
    np.testing.assert_allclose(relaxed.rotation[0, 25:].numpy(), means.reshape(30, 3), atol=1e-5)
    assert "12 coefficients" in notes[0] and "body=SMPLX_NEUTRAL.npz" in notes[0]


def test_records_come_back_and_damaged_ones_are_named(tmp_path, ingested):
    record = read_initial_poses(ingested / INITIAL_POSES)
    write_initial_poses(tmp_path / INITIAL_POSES, record)
    again = read_initial_poses(tmp_path / INITIAL_POSES)
    for field in dataclasses.fields(record):
        one, other = getattr(record, field.name), getattr(again, field.name)
        assert torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other
    (tmp_path / INITIAL_POSES).write_bytes((tmp_path / INITIAL_POSES).read_bytes()[:500])
    with pytest.raises(UserError, match=INITIAL_POSES):
        read_initial_poses(tmp_path / INITIAL_POSES)
    with pytest.raises(ValueError, match="not finite"):
        write_initial_poses(
            tmp_path / INITIAL_POSES, dataclasses.replace(record, transl=record.transl * float("nan"))
        )


def test_mean_identity_stands_for_a_missing_shape(shown, ingested):
    record = with_flat_hands(read_initial_poses(ingested / INITIAL_POSES), BODY_FILE, False)
    bare = dataclasses.replace(record, betas=None, joint_offset=None, face_offset=None)
    found, mean = given_identity(bare, shown.body, "nothing"), mean_identity(shown.body)
    assert torch.equal(found.betas, mean.betas) and torch.equal(found.face_offset, mean.face_offset)
    with pytest.raises(UserError, match="vertices"):
        given_identity(dataclasses.replace(record, face_offset=torch.zeros(10_475, 3)), shown.body, "nothing")


def test_a_given_fit_counts_as_a_registered_face(tmp_path, ingested):
    """So that the plan does not take lambda_face away from who brings fits."""
    output = fit(tmp_path / "keep", ingested, given="keep")
    record = json.loads((output / "face.json").read_text())
    assert record["registered"] == record["frames"] == COUNT
    inputs = read_inputs(ingested, output, BODY_FILE)
    assert face_registration(inputs).on
    plan = decide(inputs, PlanSettings())
    assert "no face was registered" not in plan["face_loss"].why
    assert apply_plan(TrainSettings(face=0.8), decide(inputs, PlanSettings(face_loss="on"))).face == 0.8
