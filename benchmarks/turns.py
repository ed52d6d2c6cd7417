"""A turn with and without auxiliary views, and whose face it is: ``python -m benchmarks.turns [--quick]``.

Every subject is trained twice, without auxiliary views and with the ``texture`` generator's. Shown are eight
sides of both, one row each, in the subject's own pose of the middle held-out frame. Scored are held-out PSNR
and face consistency as in the paper's supplement E.2: the embeddings' distance and cosine between the face in
a held-out frame and the rendered one, with dlib in the place of ArcFace. "clip" is the distance between
held-out frames and the middle training frame: what the person's own change of expression amounts to.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import statistics
from pathlib import Path

import numpy as np
import torch

from benchmarks.machine import described, prepare
from benchmarks.training import JudgedClip, trained
from pipeline.avatar import Avatar
from pipeline.body import Pose
from pipeline.clip.camera import Camera
from pipeline.clip.composite import composite_frame
from pipeline.clip.frames import write_png
from pipeline.config.request import parse_request
from pipeline.metrics.face_identity import ASSETS, FaceRecognizer, identity_cosine, identity_distance
from pipeline.orbit_cameras import orbit, visible_extent
from pipeline.run.job import open_job
from pipeline.run.process import make_results
from pipeline.splat import Gaussians, render
from stages.evaluate.frame_metrics import Scorer

SUBJECTS = ("smile", "oliver", "carphone", "balance")
WAYS = {"none": {"auxiliary.generator": "off"}, "texture": {"auxiliary.generator": "texture"}}
SIDES, SIZE, GREY = 8, (192, 256), 0.82
HELD_OUT = 6  # frames that are scored
BASE = {"train.iterations": "200", "train.subdivisions": "0", "train.held_out_frames": "0"}


@dataclasses.dataclass(frozen=True)
class Row:
    """One subject, one way.

    Attributes:
        subject, way: what was trained.
        psnr: of held-out frames, dB.
        distance, cosine: of rendered and filmed faces; NaN where no face was found.
        faces: in how many frames both were found.
        clip_distance: of filmed faces among themselves.
        seconds: processor time of training.
    """

    subject: str
    way: str
    psnr: float
    distance: float
    cosine: float
    faces: int
    clip_distance: float
    seconds: float


def sides(avatar: Avatar, clip: JudgedClip) -> np.ndarray:
    """Eight sides of the avatar about the vertical, beginning at the front: [H, W, 3] uint8."""
    frame = clip.test[len(clip.test) // 2]
    pose = clip.clip.pose(frame)
    upright = pose.rotation.clone()
    upright[0] = 0
    with torch.no_grad():
        gaussians = avatar.gaussians(Pose(upright, pose.expression, torch.zeros_like(pose.transl)))
        cameras = orbit(visible_extent(gaussians), *SIZE, SIDES)
        return np.hstack([shown(gaussians, camera) for camera in cameras])


def shown(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """A rendering on grey, [H, W, 3] uint8."""
    rendering = render(gaussians, camera)
    image = rendering.color + (1 - rendering.alpha[..., None]) * GREY
    return (255 * image.clamp(0, 1)).round().byte().numpy()


def faces_of(reader: FaceRecognizer, clip: JudgedClip, avatar: Avatar) -> tuple[list[float], list[float]]:
    """Distance and cosine of the held-out frames' faces and the rendered ones."""
    distances, cosines = [], []
    for frame in clip.test:
        filmed = person(clip, frame)
        drawn = (255 * clip.render(avatar, frame).color.clamp(0, 1)).round().byte().numpy()
        pair = [reader.read(image) for image in (filmed, drawn)]
        if pair[0] is not None and pair[1] is not None:
            distances.append(identity_distance(pair[0].embedding, pair[1].embedding))
            cosines.append(identity_cosine(pair[0].embedding, pair[1].embedding))
    return distances, cosines


def person(clip: JudgedClip, frame: int) -> np.ndarray:
    """The person of a frame on black, [H, W, 3] uint8."""
    image = composite_frame(clip.clip.frame(frame), clip.clip.mask(frame))
    return (255 * image).round().byte().numpy()


def own_distance(reader: FaceRecognizer, clip: JudgedClip) -> float:
    """How far the filmed faces of held-out frames lie from that of the middle training frame."""
    train = clip.clip.split.train
    middle = reader.read(person(clip, train[len(train) // 2]))
    others = [reader.read(person(clip, frame)) for frame in clip.test]
    if middle is None:
        return math.nan
    return mean([identity_distance(middle.embedding, one.embedding) for one in others if one is not None])


def mean(values: list[float]) -> float:
    """The mean; NaN of nothing."""
    return statistics.fmean(values) if values else math.nan


def try_way(subject: str, way: str, words: dict[str, str]) -> tuple[Row, np.ndarray]:
    """Trains one way on one subject; its numbers and its sides."""
    job = open_job(subject, parse_request({**words, **WAYS[way]}, subject))
    folders = {name: one.folder for name, one in make_results(job, job.stages["train"].needs).items()}
    done = trained(job)
    clip = JudgedClip.read(folders["ingest"], folders["fit"], job.workspace.body_file, HELD_OUT)
    reader = FaceRecognizer(*(job.workspace.assets / asset for asset in ASSETS))
    distances, cosines = faces_of(reader, clip, done.avatar)
    psnr = clip.scores(done.avatar, Scorer({}))["psnr"]
    own = own_distance(reader, clip)
    row = Row(subject, way, psnr, mean(distances), mean(cosines), len(distances), own, done.seconds)
    return row, sides(done.avatar, clip)


def main(arguments: list[str] | None = None) -> None:
    """Train, print a table, write the sheets, and print one headline line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.turns", description="Turns and identity.")
    parser.add_argument("--quick", action="store_true", help="a mannequin's head, 60 iterations")
    parser.add_argument("--subjects", nargs="+", metavar="NAME", help="whose avatars")
    parser.add_argument("--sheets", type=Path, metavar="FOLDER", help="write a picture a subject there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every number there")
    options = parser.parse_args(arguments)
    if arguments is None:
        prepare("benchmarks.turns", 1)
    words = {**BASE, **({"train.iterations": "60"} if options.quick else {})}
    print(f"{described()}; {words['train.iterations']} iterations, no subdivision")
    print("| subject | views | PSNR | distance | cosine | faces | clip | cpu s |\n" + "|---" * 8 + "|")
    rows: list[Row] = []
    for subject in options.subjects or (("mannequin_head",) if options.quick else SUBJECTS):
        pictures = []
        for way in WAYS:
            row, picture = try_way(subject, way, words)
            rows, pictures = [*rows, row], [*pictures, picture]
            print(_line(row), flush=True)
        if options.sheets is not None:
            options.sheets.mkdir(parents=True, exist_ok=True)
            write_png(options.sheets / f"{subject}.png", np.vstack(pictures))
    if options.json is not None:
        options.json.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=1) + "\n")
    print(_headline(rows))


def _line(row: Row) -> str:
    numbers = (
        f"{row.psnr:.2f} | {row.distance:.3f} | {row.cosine:.3f} | {row.faces} | {row.clip_distance:.3f}"
    )
    return f"| {row.subject} | {row.way} | {numbers} | {row.seconds:.0f} |"


def _headline(rows: list[Row]) -> str:
    """What auxiliary views change about held-out PSNR and identity."""
    pairs = [(rows[place], rows[place + 1]) for place in range(0, len(rows), 2)]
    change = mean([other.psnr - one.psnr for one, other in pairs])
    known = [(one, other) for one, other in pairs if not math.isnan(one.distance + other.distance)]
    distance = mean([other.distance - one.distance for one, other in known])
    return f"auxiliary views: {change:+.2f} dB held out, {distance:+.3f} of identity distance"


if __name__ == "__main__":
    main()
