"""The worth of auxiliary views, on mannequins.

Holds: docs/results.md, "Auxiliary views", and what issue 18 wants better. A mannequin with a textured back is
filmed from the front. Its avatar is trained without auxiliary views, with the ``texture`` generator's at
weights 0.1 and 1, and with the truth's own pictures of all sides at 0.1 and 1 (the ceiling). It is compared
with the truth on the seen side (the pipeline's camera) and on the side that no camera saw (135, 180 and 225
degrees), in held-out frames. The fit is the pipeline's own and the same for all. PSNR, SSIM and LPIPS are of
the person on black in the box around it.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import roma
import torch

from benchmarks import frame
from pipeline.avatar import Avatar, load_avatar
from pipeline.body import BodyModel, Poses, load_body, load_landmarks, read_poses, write_poses
from pipeline.clip.boxes import Box, person_box
from pipeline.clip.camera import Camera
from pipeline.clip.composite import composite_frame
from pipeline.clip.frames import write_frame, write_mask, write_png
from pipeline.clip.records import read_split, write_cameras
from pipeline.config.request import parse_request
from pipeline.metrics import Lpips, psnr, ssim
from pipeline.run.job import Job, open_job
from pipeline.splat import render
from pipeline.store.artifact import Artifact
from stages.ingest.mannequin.footage import Filming
from stages.ingest.mannequin.scene import FilmedFrame, Scene, film, make_background
from stages.ingest.mannequin.spec import mannequin_spec

UNSEEN = (135.0, 180.0, 225.0)  # degrees
MOTION = {"full": "sway+gesture", "upper": "sway+gesture", "head": "nod+speech"}
MARGIN = 8  # pixels around the person's box
CONTESTANTS: dict[str, dict[str, str]] = {
    "none": {"auxiliary.generator": "off"},
    "texture 0.1": {"auxiliary.generator": "texture"},
    "texture 1.0": {"auxiliary.generator": "texture", "train.generated": "1.0"},
    "truth 0.1": {"auxiliary.generator": "folder"},
    "truth 1.0": {"auxiliary.generator": "folder", "train.generated": "1.0"},
}


@dataclasses.dataclass(frozen=True)
class Row:
    """One contestant on one side of one mannequin; means over frames and cameras."""

    framing: str
    contestant: str
    side: str
    psnr: float
    ssim: float
    lpips: float


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Runs the stages and compares."""
    defaults = {
        "ingest__mannequin_views": "", "ingest__mannequin_frames": "16" if options.quick else "40",
        "ingest__test_frames": "4", "train__iterations": "100" if options.quick else "500",
        "auxiliary__frames": "24", "auxiliary__texture_guidance": "false", "train__held_out_frames": "0",
    }  # fmt: skip
    sheet: list[np.ndarray] = []
    with frame.settings_of(options, **defaults) as words:
        for framing in options.framings.split(","):
            own = {"ingest.mannequin_motion": MOTION[framing], **words}
            for row, pictures in _compared(framing, own, options.contestants.split(",")):
                report.add(row)
                sheet.extend(pictures)
    if options.sheet is not None and sheet:
        write_png(options.sheet, np.concatenate(sheet))
    return headline(report.tables["rows"])


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--framings", default="full", help="full, upper, head, joined by commas")
    parser.add_argument("--contestants", default=",".join(CONTESTANTS), help="names joined by commas")
    parser.add_argument("--sheet", type=Path, metavar="FILE", help="write pictures there")
    frame.stage_options(parser)


def _compared(
    framing: str, words: dict[str, str], contestants: list[str]
) -> Iterator[tuple[Row, list[np.ndarray]]]:
    """Every contestant's rows on one mannequin, and a strip of pictures each."""
    base = open_job(f"mannequin_{framing}", parse_request(words, f"mannequin_{framing}"))
    first = frame.made(base, "fit")
    ingest, fit = first["ingest"], first["fit"]
    scene = _scene(base)
    truth = Path(words["artifacts"]) / f"truth_{framing}"
    if not truth.is_dir():
        _write_truth(truth, scene, ingest, fit, 24)
    network = Lpips(frame.asset_folder(base.workspace, "lpips"), "alex")
    for name in contestants:
        own = CONTESTANTS[name]
        if own["auxiliary.generator"] == "folder":
            own = {**own, "auxiliary.folder": str(truth), "auxiliary.check": "false"}
        job = open_job(base.subject.name, parse_request({**words, **own}, base.subject.name))
        avatar = trained_avatar(job)
        strip: list[np.ndarray] = []
        rows = [_scored(avatar, scene, ingest, fit, side, network, strip) for side in ("seen", "unseen")]
        for place, (side, scores) in enumerate(zip(("seen", "unseen"), rows, strict=True)):
            yield Row(framing, name, side, *scores), [np.concatenate(strip, axis=1)] if place else []


def trained_avatar(job: Job) -> Avatar:
    """The avatar of a job, trained if the store lacks it."""
    return load_avatar(frame.made(job, "train")["train"].folder / "avatar.safetensors", _body(job)).eval()


def _body(job: Job) -> BodyModel:
    return load_body(job.workspace.body_file)


def _scene(job: Job) -> Scene:
    """The mannequin before the cameras, the same as ingest filmed."""
    body = _body(job)
    return Filming(
        mannequin_spec(job.settings["ingest"]), body, load_landmarks(body, job.workspace.body)
    ).scene


def around(scene: Scene, degrees: float) -> Camera:
    """The pipeline's camera carried about the middle of what is framed, towards the subject's left."""
    about = roma.rotvec_to_rotmat(torch.tensor([0.0, math.radians(degrees), 0.0]))
    shot = scene.shot
    rotation = shot.camera.rotation @ about.mT
    place = shot.centre + about @ (shot.camera.centre - shot.centre)
    return dataclasses.replace(shot.camera, rotation=rotation, translation=-rotation @ place)


def _filmed(scene: Scene, number: int, camera: Camera) -> FilmedFrame:
    return film(scene, number, camera, make_background(camera, scene.seed))


def _write_truth(folder: Path, scene: Scene, ingest: Artifact, fit: Artifact, count: int) -> None:
    """The truth's own pictures of all sides, at moments of the clip, in the layout of auxiliary.folder."""
    train, poses = read_split(ingest.folder / "split.json").train, read_poses(fit.folder / "poses.parquet")
    for kind in ("frames", "masks"):
        (folder / kind).mkdir(parents=True)
    cameras, filmed = {}, []
    for number in range(count):
        moment, camera = train[number * len(train) // count], around(scene, 360 * number / count)
        picture = _filmed(scene, moment, camera)
        write_frame(folder / "frames", number, picture.image)
        write_mask(folder / "masks", number, picture.mask)
        cameras[number] = camera
        filmed.append(poses.pose(moment))
    write_poses(folder / "poses.parquet", Poses.stack(range(count), filmed))
    write_cameras(folder / "cameras.parquet", cameras)


@torch.no_grad()
def _scored(
    avatar: Avatar,
    scene: Scene,
    ingest: Artifact,
    fit: Artifact,
    side: str,
    network: Lpips,
    strip: list[np.ndarray],
) -> tuple[float, float, float]:
    """Mean PSNR, SSIM and LPIPS over the held-out frames; pictures of the first are added to ``strip``."""
    poses = read_poses(fit.folder / "poses.parquet")
    scores = []
    for number in read_split(ingest.folder / "split.json").test:
        gaussians = avatar.gaussians(poses.pose(number))
        for degrees in UNSEEN if side == "unseen" else (0.0,):
            camera = around(scene, degrees)
            picture = _filmed(scene, number, camera)
            target = composite_frame(picture.image, picture.mask)
            image = render(gaussians, camera).color.clamp(0, 1)
            part = box_of(picture.mask).slices
            pair = image[part], target[part]
            scores.append((psnr(*pair), ssim(*pair), float(network(*pair))))
            if len(scores) <= 3:
                both = torch.cat([image, target]) * 255
                strip.append(
                    cv2.resize(both.round().byte().numpy(), (192, 384), interpolation=cv2.INTER_AREA)
                )
    return tuple(np.mean(scores, axis=0).tolist())  # type: ignore[return-value]


def box_of(mask: np.ndarray) -> Box:
    """The person's box with a margin; the whole picture where nobody is."""
    return person_box([mask], MARGIN) or Box.whole(mask)


def headline(rows: list[dict[str, Any]]) -> str:
    """The gain of texture and truth over none on either side, framing by framing."""
    found = {(row["framing"], row["contestant"], row["side"]): row["psnr"] for row in rows}
    parts = []
    for framing in dict.fromkeys(row["framing"] for row in rows):
        for name in ("texture 0.1", "truth 0.1"):
            gains = [
                f"{side} {found[framing, name, side] - found[framing, 'none', side]:+.2f} dB"
                for side in ("unseen", "seen")
                if (framing, name, side) in found and (framing, "none", side) in found
            ]
            parts += [f"{framing} {name}: {', '.join(gains)}"] if gains else []
    return "over none: " + "; ".join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("auxiliary", __doc__, measure, arguments, threads=1, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
