"""What each advice on filming is worth, on mannequins.

Holds: docs/filming.md. A mannequin is filmed in takes that differ from a good one in one thing
(``takes.py``), as H.264 clips. Each goes the whole way of a user's own clip, MediaPipe included: ingest,
fit, plan, train. Then every avatar is put into the same moments of another motion and compared with the
truth's own pictures of them, the person alone on black in the box around it: from the front, turned by 40
and 90 degrees, and from behind; face and hands by themselves from the front.

One camera cannot tell a near small body from a far large one, so each avatar is resized by one factor to the
true size of head and trunk. The true pose is given and refined on the front picture as evaluate refines
held-out poses; turned pictures are moved so that their centres lie on each other. ``again`` is the good take
with another motion: smaller differences than its are chance. ``--quick``: one person, three takes, 128 px.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks import frame
from benchmarks.auxiliary import around, box_of
from benchmarks.takes import GOOD, TAKES, Clip, Take, filming, write_take
from benchmarks.turned import on_black, shifted
from pipeline.avatar import Avatar, load_avatar
from pipeline.body import BodyModel, Identity, Pose, load_body, load_landmarks, rest_vertices
from pipeline.clip.boxes import Box
from pipeline.clip.camera import Camera, project
from pipeline.clip.fitted_clip import read_fitted_clip
from pipeline.clip.frames import write_png
from pipeline.config.request import parse_request
from pipeline.config.workspace import open_workspace
from pipeline.errors import UserError
from pipeline.metrics import Lpips, psnr
from pipeline.run.job import open_job
from pipeline.splat import Gaussians, Rendering, render
from stages.evaluate.test_pose_refinement import image_loss, refined_pose
from stages.ingest.mannequin.footage import Filming

SIDES: Mapping[str, tuple[float, ...]] = {
    "front": (0.0,), "turned": (40.0, -40.0), "side": (90.0, -90.0), "behind": (180.0,),
}  # fmt: skip
"""Name -> degrees that the camera is carried about the person."""
MOMENTS = (0.0, 1.7, 3.1, 4.6)  # seconds of the motion that is compared
COMPARED = Take(seed=100, seconds=5.0)
REFINED = 60  # steps
FACE, HAND = 0.11, 0.09  # metres from the middle of each to the sides of its box
QUICK = (GOOD, "still", "dim")


@dataclasses.dataclass(frozen=True)
class Row:
    """One take of one person, means over moments: dB, and LPIPS x100 by side.

    A blurred back has more dB than a sharp one that lies a few pixels off; LPIPS sees it the other way round.

    Attributes:
        frames: that the fit accepted for training.
    """

    person: int
    take: str
    frames: int
    gaussians: int
    front: float
    face: float
    hands: float
    turned: float
    side: float
    behind: float
    lpips_front: float
    lpips_turned: float
    lpips_side: float
    lpips_behind: float


@dataclasses.dataclass(frozen=True)
class Truth:
    """The mannequin at the moments that are compared."""

    filmed: Filming
    rows: tuple[int, ...]

    def boxes(self, row: int, camera: Camera) -> dict[str, list[Box]]:
        """Name -> boxes about the face and the hands that the picture shows."""
        sets, found = self.filmed.places.sets, {"face": [], "hands": []}
        world = self.filmed.places.world[row]
        hands = world[sets["hands"]].chunk(2)
        for name, reach, points in (
            ("face", FACE, world[sets["face_mesh"]]),
            *(("hands", HAND, h) for h in hands),
        ):
            middle = points.mean(0)
            x, y = project(camera, middle[None])[0].tolist()
            half = reach * float(camera.intrinsics[0, 0]) / -float(middle[2])
            left, top, right, bottom = round(x - half), round(y - half), round(x + half), round(y + half)
            if left >= 0 and top >= 0 and right <= camera.width and bottom <= camera.height:
                found[name].append(Box(left, top, right, bottom))
        return found


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Films, trains and compares."""
    size, steps = (128, "40") if options.quick else (256, "200")
    names = options.takes.split(",") if options.takes else list(QUICK if options.quick else TAKES)
    unknown = sorted({*names} - {*TAKES})
    if unknown:
        raise UserError(f"there is no take {unknown[0]!r}; there are {', '.join(TAKES)}")
    defaults = {
        "train__iterations": steps,
        "train__lpips": "0",
        "train__threads": "1",
        "plan__edge_pixels": "4",
    }
    workspace = open_workspace()
    body = load_body(workspace.body_file)
    landmarks = load_landmarks(body, workspace.body)
    network = Lpips(frame.asset_folder(workspace, "lpips"), "alex")
    with frame.settings_of(options, **defaults) as words, tempfile.TemporaryDirectory() as scratch:
        for person in (1,) if options.quick else tuple(map(int, options.people.split(","))):
            filmed = filming(COMPARED, person, size, body, landmarks)
            truth = Truth(filmed, tuple(round(60 * seconds) for seconds in MOMENTS))
            for name in names:
                path = Path(scratch) / f"{name.replace(' ', '_').replace(',', '')}_{person}.mp4"
                clip = write_take(path, TAKES[name], person, size, body, landmarks)
                row, strip = compared(person, name, clip, words, truth, network)
                report.add(row)
                if options.pictures is not None:
                    options.pictures.mkdir(parents=True, exist_ok=True)
                    write_png(
                        options.pictures / f"{path.stem}.png", np.concatenate([clip.picture, *strip], 1)
                    )
    return headline(report.tables["rows"])


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--people", default="1,4", help="identities of the mannequin, joined by commas")
    parser.add_argument("--takes", help=f"of {', '.join(TAKES)}; joined by commas")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write a strip of pictures a take there")
    frame.stage_options(parser)


def compared(
    person: int, name: str, clip: Clip, words: Mapping[str, str], truth: Truth, network: Lpips
) -> tuple[Row, list[np.ndarray]]:
    """A take's row, and the pictures of its first moment from all sides."""
    subject = clip.path.stem
    job = open_job(
        subject, parse_request({**words, "source": str(clip.path), "ingest.focal": f"{clip.focal}"}, subject)
    )
    made = frame.made(job, "train")
    fitted = read_fitted_clip(made["ingest"].folder, made["fit"].folder, job.workspace.body_file)
    avatar = load_avatar(made["train"].folder / "avatar.safetensors", fitted.body).eval()
    factor = true_size(fitted.body, truth.filmed.scene.clothed, fitted.identity)
    scores: dict[str, list[float]] = {}
    strip = []
    for row in truth.rows:
        camera = truth.filmed.scene.shot.camera
        pose = posed_like(avatar, truth, row, factor)
        for side, angles in SIDES.items():
            for degrees in angles:
                turned = around(truth.filmed.scene, degrees)
                picture, mask = on_black(truth.filmed.scene, row, turned)
                shown = shown_by(avatar, pose, factor, turned)
                image, part = shown.color.clamp(0, 1), box_of(mask).slices
                if degrees:
                    image = shifted(image, shown.alpha, mask)
                scores.setdefault(side, []).append(psnr(image[part], picture[part]))
                perceived = 100 * float(network(image[part], picture[part]))
                scores.setdefault(f"lpips_{side}", []).append(perceived)
                if not degrees:
                    for what, boxes in truth.boxes(row, camera).items():
                        found = [psnr(image[box.slices], picture[box.slices]) for box in boxes]
                        scores.setdefault(what, []).extend(found)
                if row == truth.rows[0] and degrees in (0.0, 40.0, 90.0, 180.0):
                    strip.append((image * 255).round().byte().numpy())
    means = {side: float(np.mean(values)) for side, values in scores.items()}
    return Row(person, name, len(fitted.split.train), len(avatar.trust), **means), strip


def true_size(body: BodyModel, true: Identity, fitted: Identity) -> float:
    """The factor between two bodies' heads and trunks."""
    upper = (body.v_template[:, 1] > body.v_template[:, 1].max() - 0.6) & (body.v_template[:, 0].abs() < 0.22)
    spread = [
        (part - part.mean(0)).norm() for part in (rest_vertices(body, one)[upper] for one in (true, fitted))
    ]
    return float(spread[0] / spread[1])


def resized(gaussians: Gaussians, factor: float, about: Tensor) -> Gaussians:
    """Gaussians made larger about a point [3]."""
    means = about + factor * (gaussians.means - about)
    return dataclasses.replace(gaussians, means=means, scales=factor * gaussians.scales)


def shown_by(avatar: Avatar, pose: Pose, factor: float, camera: Camera) -> Rendering:
    """An avatar's picture in a pose."""
    with torch.no_grad():
        return render(resized(avatar.gaussians(pose), factor, pose.transl), camera)


def posed_like(avatar: Avatar, truth: Truth, row: int, factor: float) -> Pose:
    """The true pose of a moment, refined on its front picture."""
    scene = truth.filmed.scene
    camera = scene.shot.camera
    picture, mask = on_black(scene, row, camera)
    pose = scene.shot.poses.pose(scene.shot.poses.frames[row])
    # The same place in the picture first: the middle of the silhouette, at the true distance.
    alpha = shown_by(avatar, pose, factor, camera).alpha.numpy()
    moments = [cv2.moments(one.astype(np.float32)) for one in (alpha, mask)]
    if min(one["m00"] for one in moments) > 0:
        (x, y), (to_x, to_y) = ((one["m10"] / one["m00"], one["m01"] / one["m00"]) for one in moments)
        metre = -float(pose.transl[2]) / float(camera.intrinsics[0, 0])
        pose = dataclasses.replace(pose, transl=pose.transl + torch.tensor([to_x - x, y - to_y, 0.0]) * metre)

    def loss(tried: Pose) -> Tensor:
        return image_loss(
            render(resized(avatar.gaussians(tried), factor, tried.transl), camera).color, picture
        )

    for parameter in avatar.parameters():
        parameter.requires_grad_(False)
    return refined_pose(loss, pose, REFINED) or pose


def headline(rows: list[dict[str, Any]]) -> str:
    """What each take gains over the good one, from the front and turned by 40 degrees, mean over people."""
    good = {row["person"]: row for row in rows if row["take"] == GOOD}
    parts = []
    for name in dict.fromkeys(row["take"] for row in rows if row["take"] != GOOD):
        chosen = [row for row in rows if row["take"] == name and row["person"] in good]
        if chosen:
            gain = {
                side: np.mean([row[side] - good[row["person"]][side] for row in chosen])
                for side in ("front", "turned")
            }
            parts.append(f"{name} {gain['front']:+.1f} / {gain['turned']:+.1f} dB")
    if not parts:
        return f"{len(rows)} takes, none beside the good one"
    return "front / turned by 40 degrees against the good take: " + ", ".join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("filming", __doc__, measure, arguments, threads=1, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
