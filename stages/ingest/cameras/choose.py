"""The choice of a clip's cameras: read, found or a static pinhole; in metres, in an upright world."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import torch

from pipeline.clip.camera import Camera, facing_camera
from pipeline.clip.keypoints import Keypoints
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses
from stages.ingest.cameras.background_motion import measure_motion
from stages.ingest.cameras.calibration import (
    EVERY_FRAME,
    CalibratedCamera,
    Calibration,
    frames_of_views,
    pinhole_lens,
)
from stages.ingest.cameras.distortion import (
    LEFT_ALONE,
    distortion_pixels,
    for_stored_frames,
    without_distortion,
)
from stages.ingest.cameras.extrinsics import interpolate_gaps, to_upright_world
from stages.ingest.cameras.rotation_only import (
    MOSTLY_ROTATION,
    ROTATION_ONLY,
    chain_rotations,
    unexplained_by_rotation,
)
from stages.ingest.cameras.scale import Scale, metric_scale, person_positions, posed_positions
from stages.ingest.cameras.structure_from_motion import mapped_frames, structure_from_motion
from stages.ingest.detect import DetectedClip
from stages.ingest.video import Clip

if TYPE_CHECKING:
    from pipeline.run.stage import Context

GAP_SECONDS = 0.5  # over which a camera is interpolated between two that are known


@dataclasses.dataclass(frozen=True)
class ClipCameras:
    """The cameras of a clip.

    Attributes:
        cameras: frame number -> pinhole of the stored frame; kept frames without one are missing.
        lenses: frame number -> the stored frame's lens, where its distortion has to be taken out.
        record: for ``footage.json``.
    """

    cameras: Mapping[int, Camera]
    lenses: Mapping[int, pycolmap.Camera]
    record: Mapping[str, Any]


def choose_cameras(
    context: Context,
    clip: Clip,
    detected: DetectedClip,
    given: Calibration | None,
    poses: InitialPoses | None = None,
) -> ClipCameras:
    """The cameras of the kept frames.

    Args:
        context: the stage's; ``frames`` and ``masks`` are written by now.
        clip: the footage.
        detected: the kept frames.
        given: the user's or the dataset's calibration, if there is one.
        poses: the dataset's, which then tell the scale.

    Raises:
        UserError: the calibration is not of this footage.
    """
    settings = context.settings
    frames = detected.keypoints.frames.tolist()
    if given is not None:
        return _from_calibration(context, clip, detected, given, poses)
    record: dict[str, Any] = {"source": "pinhole", "displacement": None, "metres_per_unit": None}
    if settings.cameras == "auto":
        motion = measure_motion(context.output, frames, kept_fps(context, clip))
        context.log(str(motion))
        record["displacement"] = round(motion.displacement, 6) if motion.pairs else None
    if settings.cameras == "sfm" or (settings.cameras == "auto" and motion.moving):
        started = time.perf_counter()
        found = _find(context, clip, detected)
        context.timing("camera_seconds", round(time.perf_counter() - started, 2))
        if found is not None:
            return dataclasses.replace(found, record={**record, **found.record})
        context.log("cameras: none could be found, so a static pinhole takes their place")
    focal = settings.focal * max(detected.width, detected.height)
    camera = facing_camera(detected.width, detected.height, focal)
    return ClipCameras(dict.fromkeys(frames, camera), {}, record)


def kept_fps(context: Context, clip: Clip) -> float:
    """Kept frames a second where every ``ingest.stride``-th frame of the clip is read."""
    return (clip.fps or 25.0) / context.settings.stride


def _find(context: Context, clip: Clip, detected: DetectedClip) -> ClipCameras | None:
    """Cameras from the background's motion; None where it gives none."""
    frames = detected.keypoints.frames.tolist()
    width, height = detected.width, detected.height
    focal = context.settings.focal * max(width, height)
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    share = unexplained_by_rotation(context.output, frames, kept_fps(context, clip), matrix)
    if share > ROTATION_ONLY:
        centre = (width / 2, height / 2)
        found = structure_from_motion(context.output, context.work / "sfm", frames, focal, centre)
        if not isinstance(found, str):
            return _from_model(context, clip, detected, found)
        context.log(f"cameras: structure from motion failed: {found}")
    rotations = chain_rotations(context.output, frames, matrix) if share <= MOSTLY_ROTATION else None
    if rotations is None:
        context.log(
            f"cameras: rotations leave {share:.0%} of the background's motion unexplained, or lose it"
        )
        return None
    context.log(f"cameras: rotations only, which leave {share:.1%} of the background's motion unexplained")
    lens = pinhole_lens(width, height, (focal, focal), (width / 2, height / 2))
    views = {f: CalibratedCamera(lens, r, np.zeros(3)) for f, r in zip(frames, rotations, strict=True)}
    return ClipCameras(_cameras(_settled(views)), {}, {"source": "rotation", "unexplained": round(share, 6)})


def _from_model(context: Context, clip: Clip, detected: DetectedClip, model: Calibration) -> ClipCameras:
    """The cameras of a model of this clip and of the frames between them, in metres."""
    frames = detected.keypoints.frames.tolist()
    known = {int(name[:-4]): view for name, view in model.views.items()}
    lens = next(iter(known.values())).lens
    mapped = mapped_frames(frames)
    longest = max(GAP_SECONDS * (clip.fps or 25.0), 3 * float(np.diff(mapped).max(initial=1)))
    poses = interpolate_gaps({f: (v.rotation, v.translation) for f, v in known.items()}, frames, int(longest))
    views = {frame: CalibratedCamera(lens, *pose) for frame, pose in poses.items()}
    scaled, scale = _metric(context, detected.keypoints, views, kept_fps(context, clip), model)
    context.log(
        f"cameras: structure from motion placed {len(known)} of {len(mapped)} frames, focal length "
        f"{lens.mean_focal_length():.0f} pixels; {scale.note}"
    )
    record = {
        "source": "sfm",
        "metres_per_unit": scale.metres,
        "placed": len(known),
        "interpolated": len(views) - len(set(views) & set(known)),
    }
    return ClipCameras(_cameras(_settled(scaled)), {}, record)


def _from_calibration(
    context: Context, clip: Clip, detected: DetectedClip, given: Calibration, poses: InitialPoses | None
) -> ClipCameras:
    """The cameras that the user or the dataset gives."""
    frames = detected.keypoints.frames.tolist()
    stored = {
        name: for_stored_frames(view, clip, detected.width, detected.height, given.path)
        for name, view in given.views.items()
    }
    if EVERY_FRAME in stored:
        views = dict.fromkeys(frames, stored[EVERY_FRAME])
    else:
        whole = context.settings.stride == 1 and not context.settings.max_frames
        total = detected.read if whole else clip.expected
        numbers, how = frames_of_views(given, clip, total, context.settings.first_number)
        context.log(f"cameras: {given.path.name}: {how}")
        known = {numbers[name]: view for name, view in stored.items()}
        views = {frame: known[frame] for frame in frames if frame in known}
    if not views:
        raise UserError(
            f"{given.path} has a camera for none of the frames that show a person: check its names"
        )
    scale = Scale(1.0, "metres as given")
    if not given.metric:
        rate = kept_fps(context, clip)
        views, scale = _metric(context, detected.keypoints, views, rate, given, poses)
    bent = {
        number: distortion_pixels(lens)
        for number, lens in {id(v.lens): v.lens for v in views.values()}.items()
    }
    lenses = {f: v.lens for f, v in views.items() if bent[id(v.lens)] > LEFT_ALONE}
    context.log(
        f"cameras: {given.kind}, {given.path.name}: {len(views)} of {len(frames)} frames; "
        f"{scale.note}; {_distorted(max(bent.values()), bool(lenses))}"
    )
    if not given.upright:
        views = _settled(views)
    record = {
        "source": given.kind,
        "metres_per_unit": scale.metres,
        "distortion_pixels": round(max(bent.values()), 3),
        "undistorted": bool(lenses),
        "displacement": None,
    }
    return ClipCameras(_cameras(views), lenses, record)


def _distorted(pixels: float, taken_out: bool) -> str:
    if pixels < 1e-3:
        return "no distortion"
    fate = "taken out of the frames" if taken_out else "left as it is"
    return f"distortion of up to {pixels:.2f} pixels {fate}"


def _metric(
    context: Context,
    keypoints: Keypoints,
    views: Mapping[int, CalibratedCamera],
    fps: float,
    model: Calibration,
    poses: InitialPoses | None = None,
) -> tuple[dict[int, CalibratedCamera], Scale]:
    """The views with translations in metres."""
    given = context.settings.camera_scale
    scale = Scale(given, f"{given:g} metres a unit, as set")
    if not given:
        rows = np.flatnonzero(np.isin(keypoints.frames, list(views)))
        chosen = [views[int(frame)] for frame in keypoints.frames[rows]]
        lenses = [view.lens for view in chosen]
        focal = np.array([[lens.focal_length_x, lens.focal_length_y] for lens in lenses])
        centre = np.array([[lens.principal_point_x, lens.principal_point_y] for lens in lenses])
        placed, places = posed_positions(keypoints.frames[rows], poses)
        if not len(placed):
            placed, places = person_positions(keypoints.select(rows), focal, centre)
        rotations = np.stack([view.rotation for view in chosen])[placed]
        translations = np.stack([view.translation for view in chosen])[placed]
        scale = metric_scale(rotations, translations, places, fps, model.depth)
    metres = scale.metres
    scaled = {f: dataclasses.replace(v, translation=v.translation * metres) for f, v in views.items()}
    return scaled, scale


def _settled(views: Mapping[int, CalibratedCamera]) -> dict[int, CalibratedCamera]:
    """The same cameras in an upright world."""
    order = sorted(views)
    parts = (
        np.stack([getattr(views[frame], name) for frame in order]) for name in ("rotation", "translation")
    )
    poses = zip(order, *to_upright_world(*parts), strict=True)
    return {frame: dataclasses.replace(views[frame], rotation=r, translation=t) for frame, r, t in poses}


def _cameras(views: Mapping[int, CalibratedCamera]) -> dict[int, Camera]:
    """The pinholes of views of the stored frames."""
    cameras = {}
    for frame, view in sorted(views.items()):
        lens = without_distortion(view.lens)
        arrays = (lens.calibration_matrix(), view.rotation, view.translation)
        tensors = (torch.tensor(np.asarray(array), dtype=torch.float64) for array in arrays)
        cameras[frame] = Camera(lens.width, lens.height, *tensors)
    return cameras
