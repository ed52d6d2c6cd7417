"""The fit against cameras that it never saw.

Holds: docs/results.md, "Held-out cameras", and issue 19's goal of 12 px. ``balance`` has four calibrated
cameras. The body is fitted on camera 1 alone, under its calibrated camera so that the world is the rig's, and
its joints are projected into cameras 1 to 4 and compared with what was detected there. Beside the fit stand
its initialisation (no iterations) and a floor: the detections of the other cameras triangulated and
projected, which is what detector and calibration allow. ``--quick``: every fourth frame, 100 iterations.

Each row is given twice: as it is, and after every frame's points were scaled along camera 1's rays by the
factor that suits cameras 2 to 4 best, since one camera cannot tell a near small body from a far large one.
A frame in which the detector exchanged left and right in one camera, which the epipolar geometry between
detections shows, is left out of that camera's rows for all contestants.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import frame
from pipeline.body import (
    joint_transforms,
    linear_blend_skinning,
    load_body,
    load_landmarks,
    locate,
    posed_joints,
    read_identity,
    read_poses,
    rest_joints,
    rest_vertices,
)
from pipeline.clip.frames import read_mask
from pipeline.clip.keypoints import read_keypoints
from pipeline.clip.records import read_cameras
from pipeline.config.request import parse_request
from pipeline.config.workspace import open_workspace
from pipeline.run.job import Job, open_job
from pipeline.store.artifact import Artifact

GROUPS = {
    "shoulders": (11, 12), "elbows": (13, 14), "wrists": (15, 16),
    "hips": (23, 24), "knees": (25, 26), "ankles": (27, 28),
}  # fmt: skip
"""Points of MediaPipe's pose, whose places on the body are known."""
POINTS = tuple(point for group in GROUPS.values() for point in group)
MIRRORED = tuple(place ^ 1 for place in range(len(POINTS)))
SCORE = 0.5
CAMERAS = (1, 2, 3, 4)
EXCHANGED = 0.5  # sides count as exchanged where that halves the epipolar distance
RAY_SCALES = np.exp(np.linspace(np.log(0.7), np.log(1.4), 141))


@dataclasses.dataclass(frozen=True)
class Watched:
    """What one camera saw, T frames and N points.

    Attributes:
        projection: [3, 4] float64, world metres -> pixels of the stored frame; the camera stands still.
        pixels: [T, N, 2] float64, detections.
        seen: [T, N] bool: scored at least ``SCORE`` and inside the picture.
        height: the person's, median over the frames, pixels.
    """

    projection: np.ndarray
    pixels: np.ndarray
    seen: np.ndarray
    height: float

    @property
    def centre(self) -> np.ndarray:
        """Where the camera is, [3], metres."""
        return -np.linalg.solve(self.projection[:, :3], self.projection[:, 3])

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points [..., 3] as pixels [..., 2]."""
        image = points @ self.projection[:, :3].T + self.projection[:, 3]
        return image[..., :2] / image[..., 2:]

    def error(self, points: np.ndarray) -> np.ndarray:
        """Distances of projected points [T, N, 3] to their detections, [T, N] pixels, NaN where unseen."""
        distance = np.linalg.norm(self.project(points) - self.pixels, axis=-1)
        return np.where(self.seen, distance, np.nan)


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the table: errors of one contestant in one camera, over a group of joints."""

    contestant: str
    camera: str
    joints: str
    points: int
    mean: float
    median: float
    percent_of_height: float
    mean_without_depth: float
    median_without_depth: float


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Runs the stages and compares."""
    quick = {"ingest__stride": "4", "fit__iterations": "100"} if options.quick else {}
    with frame.settings_of(options, **quick) as words:
        frames, watched, contestants = _contestants(words)
        for number, one in zip(CAMERAS, watched, strict=True):
            lost = int((~one.seen.any(1)).sum())
            row = {"camera": number, "person_px": one.height, "frames": len(frames), "left_out": lost}
            report.add(row, "cameras")
        for row in table(watched, contestants):
            report.add(row)
    return headline(report.tables["rows"])


def _contestants(words: dict[str, str]) -> tuple[np.ndarray, list[Watched], dict[str, np.ndarray]]:
    """Frame numbers [T], what the cameras saw, and each contestant's points [T, N, 3], metres.

    The floor has an entry a camera, "floor 1" to "floor 4".
    """
    jobs = [job_of(words, number) for number in CAMERAS]
    ingested = [frame.made(job, "ingest")["ingest"] for job in jobs]
    frames = _common_frames(ingested)
    watched = without_exchanges([_watched(artifact.folder, frames) for artifact in ingested])
    start = dataclasses.replace(
        jobs[0],
        settings={**jobs[0].settings, "fit": dataclasses.replace(jobs[0].settings["fit"], iterations=0)},
    )
    contestants = {
        "fit": _fitted_points(jobs[0], frames),
        "initialisation": _fitted_points(start, frames),
    }
    for place, number in enumerate(CAMERAS):
        contestants[f"floor {number}"] = triangulated([w for k, w in enumerate(watched) if k != place])
    return frames, watched, contestants


def job_of(words: dict[str, str], number: int) -> Job:
    """The job of one camera of the rig."""
    asset = frame.asset_folder(open_workspace(), "balance")
    own = {
        "source": str(asset / "videos" / f"cam0{number}.mp4"),
        "ingest.cameras": str(asset / "calibration" / "Calib.qca.txt"),
        "ingest.camera_name": f"cam0{number}",
        "ingest.test_fraction": "0",
        "fit.accept": "any",  # the start, which takes no step, is looked at too
    }
    return open_job("balance", parse_request({**own, **words}, "balance"))


def _common_frames(ingested: Sequence[Artifact]) -> np.ndarray:
    """The frames in which every camera found the person."""
    kept = [read_keypoints(artifact.folder / "keypoints.parquet").frames for artifact in ingested]
    common = set(kept[0].tolist()).intersection(*(frames.tolist() for frames in kept[1:]))
    return np.array(sorted(common))


def _watched(folder: Path, frames: np.ndarray) -> Watched:
    """What a camera saw in some frames."""
    camera = read_cameras(folder / "cameras.parquet", torch.float64)[int(frames[0])]
    pose = torch.cat([camera.rotation, camera.translation[:, None]], dim=1)
    keypoints = read_keypoints(folder / "keypoints.parquet")
    points = keypoints.pose_image[np.searchsorted(keypoints.frames, frames)][:, POINTS].astype(np.float64)
    inside = ((points[..., :2] >= 0) & (points[..., :2] <= [camera.width, camera.height])).all(-1)
    heights = [np.ptp(np.flatnonzero((read_mask(folder / "masks", int(f)) > 127).any(1))) for f in frames]
    return Watched(
        (camera.intrinsics @ pose).numpy(),
        points[..., :2],
        inside & (points[..., 3] >= SCORE),
        float(np.median(heights)),
    )


def without_exchanges(watched: list[Watched]) -> list[Watched]:
    """Cameras 2 to 4 without the frames in which the detector took left for right.

    Left and right exchanged in camera 1 itself would take the frame out of all the others.
    """
    first, cleaned = watched[0], [watched[0]]
    for other in watched[1:]:
        straight = np.nanmedian(_epipolar(first, other, np.arange(len(POINTS))), axis=1)
        exchanged = np.nanmedian(_epipolar(first, other, np.array(MIRRORED)), axis=1)
        bad = exchanged < EXCHANGED * straight
        cleaned.append(dataclasses.replace(other, seen=other.seen & ~bad[:, None]))
    return cleaned


def _epipolar(first: Watched, other: Watched, order: np.ndarray) -> np.ndarray:
    """Distances of the other camera's points, in some order, to the first's epipolar lines, [T, N] pixels."""
    to_other = other.projection[:, :3] @ np.linalg.inv(first.projection[:, :3])
    epipole = other.projection @ np.append(first.centre, 1.0)
    rays = np.concatenate([first.pixels, np.ones((*first.pixels.shape[:2], 1))], axis=-1)
    lines = np.cross(epipole, rays @ to_other.T)
    points = other.pixels[:, order]
    distance = np.abs((lines[..., :2] * points).sum(-1) + lines[..., 2])
    return np.where(
        first.seen & other.seen[:, order], distance / np.linalg.norm(lines[..., :2], axis=-1), np.nan
    )


def triangulated(watched: Sequence[Watched]) -> np.ndarray:
    """Points [T, N, 3] by linear least squares from the cameras that see them; NaN if fewer than two do."""
    equations = []
    for one in watched:
        rows = one.pixels[..., None] * one.projection[2] - one.projection[:2]  # [T, N, 2, 4]
        rows = rows / np.linalg.norm(one.projection[2, :3])
        equations.append(rows * one.seen[..., None, None])
    solution = np.linalg.svd(np.concatenate(equations, axis=2))[2][..., -1, :]
    points = solution[..., :3] / solution[..., 3:]
    enough = np.sum([one.seen for one in watched], axis=0) >= 2
    return np.where(enough[..., None], points, np.nan)


def _fitted_points(job: Job, frames: np.ndarray) -> np.ndarray:
    """The fitted body's points in the rig's world, [T, N, 3] metres."""
    folder = frame.made(job, "fit")["fit"].folder
    body = load_body(job.workspace.body_file)
    vertex_ids, points = load_landmarks(body, job.workspace.body).pose[torch.tensor(POINTS)].compact()
    identity, poses = (
        read_identity(folder / "identity.safetensors", body),
        read_poses(folder / "poses.parquet"),
    )
    joints = rest_joints(body, identity)
    chosen = poses.select(int(frame) for frame in frames)
    rotation, transl = chosen.rotation, chosen.transl[:, None]
    transforms = joint_transforms(rotation, joints, body.parents)
    rest = rest_vertices(body, identity)[vertex_ids]
    vertices = linear_blend_skinning(transforms, body.skinning_weights[vertex_ids], rest) + transl
    posed = posed_joints(rotation, joints, body.parents) + transl
    return locate(points, posed, vertices).double().numpy()


def along_rays(points: np.ndarray, watched: Sequence[Watched]) -> np.ndarray:
    """Each frame's points scaled from camera 1's centre by what suits the other cameras best."""
    centre = watched[0].centre
    totals = []
    for scale in RAY_SCALES:
        errors = np.stack([one.error(centre + scale * (points - centre)) for one in watched[1:]])
        totals.append(np.nansum(errors, axis=(0, 2)))
    best = RAY_SCALES[np.argmin(totals, axis=0)]
    return centre + best[:, None, None] * (points - centre)


def table(watched: Sequence[Watched], contestants: dict[str, np.ndarray]) -> Iterator[Row]:
    """Every contestant in every camera, then the held-out cameras together, joint group by joint group."""
    for name in ("fit", "initialisation", "floor"):
        errors, scaled = [], []
        for place, one in enumerate(watched):
            points = contestants[f"floor {CAMERAS[place]}" if name == "floor" else name]
            errors.append(one.error(points) / one.height)
            scaled.append(
                errors[-1] if name == "floor" else one.error(along_rays(points, watched)) / one.height
            )
            yield _row(name, str(CAMERAS[place]), "all", errors[-1:], scaled[-1:], [one.height])
        heights = [one.height for one in watched[1:]]
        yield _row(name, "2-4", "all", errors[1:], scaled[1:], heights)
        for place, group in enumerate(GROUPS):
            columns = slice(2 * place, 2 * place + 2)
            parts = [[error[:, columns] for error in kind[1:]] for kind in (errors, scaled)]
            yield _row(name, "2-4", group, parts[0], parts[1], heights)


def _row(
    name: str,
    camera: str,
    joints: str,
    errors: Sequence[np.ndarray],
    scaled: Sequence[np.ndarray],
    heights: Sequence[float],
) -> Row:
    """Statistics over cameras of errors [T, N], parts of the person's height there, NaN where unseen."""
    pixels = [
        np.concatenate([(error * height).ravel() for error, height in zip(kind, heights, strict=True)])
        for kind in (errors, scaled)
    ]
    plain, free = (values[np.isfinite(values)] for values in pixels)
    parts = np.concatenate([error.ravel() for error in errors])
    return Row(
        name, camera, joints, len(plain), float(plain.mean()), float(np.median(plain)),
        100 * float(np.nanmean(parts)), float(free.mean()), float(np.median(free)),
    )  # fmt: skip


def headline(rows: Sequence[dict[str, Any]]) -> str:
    """One line: every contestant in cameras 2 to 4."""
    found = [row for row in rows if row["camera"] == "2-4" and row["joints"] == "all"]
    return "; ".join(
        f"{row['contestant']} {row['mean']:.2f} px ({row['percent_of_height']:.1f}% of the height, "
        f"depth free {row['mean_without_depth']:.2f} px)"
        for row in found
    )


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("held_out_views", __doc__, measure, arguments, options=frame.stage_options)


if __name__ == "__main__":
    sys.exit(main())
