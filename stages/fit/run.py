"""Running the fit stage: keypoints in, identity and poses out."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from pipeline.body import (
    BodyModel,
    Identity,
    Poses,
    load_body,
    load_landmarks,
    rest_vertices,
    write_identity,
    write_poses,
)
from pipeline.clip.camera import Camera
from pipeline.clip.clock import frame_times
from pipeline.clip.fit_quality import write_fit_quality
from pipeline.clip.frames import spread_end_to_end, write_png, write_video
from pipeline.clip.keypoints import read_keypoints
from pipeline.clip.records import read_cameras, read_footage
from pipeline.files.json_files import write_json
from pipeline.files.tables import write_table
from pipeline.numba_kernels import threads
from pipeline.pose_files import read_hand_mean, write_peer_files
from pipeline.run.stage import Context
from stages.fit import judge
from stages.fit.initialise_from_poses import given_poses, keep_given
from stages.fit.observations import GROUPS, Observations
from stages.fit.overlay import SHEET_FRAMES, overlays, sheet
from stages.fit.registration import Registration, register, views_of
from stages.fit.settings import FitSettings
from stages.fit.smoothing import smooth, window_of

RESIDUALS_SCHEMA = pa.schema(
    [("frame", pa.int32()), ("group", pa.string()), ("point", pa.int32()), ("pixels", pa.float32())]
)
_FPS = 25.0  # of the overlay, where the footage has no clock


def run(context: Context) -> None:
    """Fit a clip and publish identity, poses, template, residuals and overlays."""
    with threads(1):
        _run(context)


def _run(context: Context) -> None:
    ingest = context.inputs["ingest"]
    body = load_body(context.body_file)
    cameras = read_cameras(ingest / "cameras.parquet")
    start, cpu = time.monotonic(), time.process_time()
    fitted = fit_clip(context, body, cameras)
    context.timing("registration_seconds", round(time.monotonic() - start, 2))
    context.timing("registration_cpu_seconds", round(time.process_time() - cpu, 2))
    context.timing("curve_seconds", [[step, round(at, 3)] for step, at in fitted.seconds])
    times = frame_times(fitted.poses.frames, read_footage(ingest / "footage.json"))
    smoothed = published_poses(fitted, context.settings, times)
    judge_fit(context, body, fitted, smoothed, cameras)
    means = group_means(fitted.error, fitted.observations)
    summary = ", ".join(f"{name} {mean:.2f} px" for name, mean in means.items())
    context.log(f"reprojection: {summary or 'no keypoint was trusted in any frame'}")
    write_identity(context.output / "identity.safetensors", fitted.identity, body)
    write_motion(context, body, fitted, smoothed, cameras)
    write_residuals(context.output / "residuals.parquet", fitted.error, fitted.observations)
    source = "given" if context.settings.given == "keep" else context.settings.face
    registered = {"source": source, "frames": len(smoothed), "registered": fitted.face_frames}
    write_json(context.output / "face.json", registered)  # what the plan says of face registration
    fitted.curve.write(context.output / "curve.parquet")
    write_template(context.output / "template.ply", body, fitted.identity)
    start = time.monotonic()
    write_overlays(context, body, fitted.identity, smoothed, cameras)
    context.timing("overlay_seconds", round(time.monotonic() - start, 2))


def published_poses(fitted: Registration, settings: FitSettings, times: np.ndarray) -> Poses:
    """The poses that are published: smoothed, but for eyes, steadied on their own, and for kept poses."""
    if settings.given == "keep":
        return fitted.poses
    smoothed = smooth(fitted.poses, window_of(settings.smoothing_seconds, times), times=times)
    if fitted.eyes is None:
        return smoothed
    expression, rotation = fitted.eyes.applied(smoothed.expression, smoothed.rotation)
    return dataclasses.replace(smoothed, expression=expression, rotation=rotation)


def fit_clip(context: Context, body: BodyModel, cameras: Mapping[int, Camera]) -> Registration:
    """Register the body to the clip that ingest published."""
    settings, ingest = context.settings, context.inputs["ingest"]
    landmarks = load_landmarks(body, context.body)
    keypoints = read_keypoints(ingest / "keypoints.parquet")
    frames = keypoints.frames.tolist()
    initial = given_poses(settings, ingest, body, context.body_file, frames, context.log)
    kept = None
    if settings.given == "keep" and initial is not None:
        kept = keep_given(initial, body, views_of(keypoints, cameras))
        settings = dataclasses.replace(settings, iterations=0, face="off", lambda_lids=0.0, lambda_gaze=0.0)
        context.log("publishes the poses that came with the footage as they are")
    with context.progress(settings.iterations, "registration") as progress:

        def report(note: str) -> None:
            progress.advance(1, note)

        footage = read_footage(ingest / "footage.json")
        times = frame_times(keypoints.frames, footage)
        fitted = register(
            body,
            landmarks,
            keypoints,
            cameras,
            settings,
            report,
            initial,
            context.log,
            footage.all_frames,
            times,
            ingest / "masks",
        )
    if kept is None:
        return fitted
    identity, poses = kept  # whose face is as registered as the rest of it
    return dataclasses.replace(fitted, identity=identity, poses=poses, face_frames=int(poses.valid.sum()))


def judge_fit(
    context: Context, body: BodyModel, fitted: Registration, smoothed: Poses, cameras: Mapping[int, Camera]
) -> None:
    """Write ``fit_quality.parquet``; the log names the frames that are left out.

    Raises:
        UserError: too many frames fail; see ``judge.decide``.
    """
    settings, ingest = context.settings, context.inputs["ingest"]
    keypoints, start = read_keypoints(ingest / "keypoints.parquet"), time.monotonic()
    error = None if settings.given == "keep" else fitted.error  # poses that are kept were not fitted
    with context.progress(len(smoothed), "judging the fit") as progress:
        quality = judge.measure_fit(
            body, fitted.identity, smoothed, keypoints, cameras, error, ingest / "masks",
            settings.score_threshold, progress.advance,
        )  # fmt: skip
    context.timing("judge_seconds", round(time.monotonic() - start, 2))
    turned = judge.turned_faces(keypoints, settings.score_threshold)
    name = read_footage(ingest / "footage.json").name
    quality, note = judge.decide(quality, name, turned, settings.accept == "any")
    context.log(f"judged: {quality.figures()}")
    if note:
        context.log(note)
    write_fit_quality(context.output, quality)


def write_motion(
    context: Context, body: BodyModel, fitted: Registration, smoothed: Poses, cameras: Mapping[int, Camera]
) -> None:
    """Write ``poses.parquet``, which is smoothed, ``poses_raw.parquet``, and on request the peers' files."""
    write_poses(context.output / "poses.parquet", smoothed)
    write_poses(context.output / "poses_raw.parquet", fitted.poses)
    if context.settings.export_peers:
        folder, mean = context.output / "peers", read_hand_mean(context.body_file)
        write_peer_files(folder, body, fitted.identity, fitted.poses, smoothed, cameras, mean)


def group_means(error: Tensor, observations: Observations) -> dict[str, float]:
    """Mean error over the clip of each group that was seen, pixels.

    Args:
        error: [T, N], pixels, NaN where masked.
    """
    means = {name: error[:, observations.of(name)].nanmean() for name in GROUPS}
    return {name: float(mean) for name, mean in means.items() if torch.isfinite(mean)}


def write_residuals(path: Path, error: Tensor, observations: Observations) -> None:
    """Write ``residuals.parquet``, a row a keypoint that was trusted in a frame.

    Columns: ``frame``; ``group`` and ``point``, the keypoint as the number that its source gives it within
    the group; ``pixels``, its reprojection error. Masked keypoints have no row.

    Args:
        error: [T, N], pixels, NaN where masked.
    """
    group = observations.group.numpy()
    within = np.zeros(len(group), np.int32)
    for number in range(len(GROUPS)):
        within[group == number] = np.arange((group == number).sum())
    rows, points = np.nonzero(~np.isnan(error.numpy()))
    columns = {
        "frame": observations.frames.numpy()[rows].astype(np.int32),
        "group": np.array(GROUPS, dtype=object)[group[points]],
        "point": within[points],
        "pixels": error.numpy()[rows, points],
    }
    write_table(path, RESIDUALS_SCHEMA, columns)


def write_template(path: Path, body: BodyModel, identity: Identity) -> None:
    """Write the identity's mesh in T pose as binary PLY, metres."""
    import trimesh  # a second of the stage's start, were it above

    with torch.no_grad():
        vertices = rest_vertices(body, identity).numpy()
    mesh = trimesh.Trimesh(vertices, body.faces.numpy(), process=False)
    path.write_bytes(trimesh.exchange.ply.export_ply(mesh, vertex_normal=False))


def write_overlays(
    context: Context, body: BodyModel, identity: Identity, poses: Poses, cameras: Mapping[int, Camera]
) -> None:
    """Write ``overlay.mp4``, every frame, and ``overlay.png``, a contact sheet."""
    ingest = context.inputs["ingest"]
    wanted, kept = spread_end_to_end(range(len(poses)), SHEET_FRAMES), {}
    opacity = context.settings.overlay_opacity

    def drawing() -> Iterator[np.ndarray]:
        pictures = overlays(body, identity, poses, cameras, ingest / "frames", opacity)
        with context.progress(len(poses), "overlay") as progress:
            for row, picture in enumerate(pictures):
                if row in wanted:
                    kept[row] = picture
                yield picture
                progress.advance()

    write_video(context.output / "overlay.mp4", drawing(), read_footage(ingest / "footage.json").fps or _FPS)
    write_png(context.output / "overlay.png", sheet(ingest / "frames", ingest / "masks", poses, kept))
