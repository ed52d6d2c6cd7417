"""Avatars of mannequins that were filmed from the front, looked at from all sides.

Holds: docs/results.md, "Turned", and what issue 18 asks. Each contestant is trained on the same clip and
compared with the truth at nine angles, in held-out moments: with the true body and poses given, so that only
what happens between evidence and completion is judged, and with the pipeline's own fit, there as it is and
after the shift that lays its centre on the truth's (depth from one camera is off). PSNR and LPIPS are of the
person on black in the box around it; holes and speckle are evaluate's (``stages/evaluate/turned.py``).
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks import frame
from benchmarks.auxiliary import around, box_of
from pipeline.avatar import Avatar
from pipeline.body import Pose, load_body, load_landmarks
from pipeline.clip.camera import Camera
from pipeline.clip.composite import composite_frame
from pipeline.clip.fit_quality import FitQuality
from pipeline.clip.fitted_clip import FittedClip, read_fitted_clip
from pipeline.clip.foreground import FOREGROUND
from pipeline.clip.frames import write_frame, write_mask, write_png
from pipeline.clip.records import Split, read_split
from pipeline.config.request import parse_request
from pipeline.metrics import Lpips, psnr
from pipeline.orbit_cameras import relaxed_pose
from pipeline.run.job import Job, open_job
from pipeline.splat import render
from pipeline.texture import fine_surface, gather_colors, paint
from stages.auxiliary.texture_generator import complete
from stages.evaluate.textured_mesh import nearest_known
from stages.evaluate.turned import look_around, seen_surface
from stages.ingest.foreground import write_foreground
from stages.ingest.mannequin.footage import Filming
from stages.ingest.mannequin.scene import FilmedFrame, Scene, film, make_background
from stages.ingest.mannequin.spec import mannequin_spec
from stages.ingest.mannequin.truth import read_truth
from stages.train.data import TrainingData
from stages.train.frame_evidence import settle_unseen
from stages.train.run import build_trainer
from stages.train.settings import TrainSettings, for_bases

ANGLES = (0.0, 30.0, -30.0, 60.0, -60.0, 90.0, -90.0, 135.0, 180.0, 225.0)
SIDES = {"front": (0.0,), "sides": (60.0, -60.0, 90.0, -90.0), "behind": (135.0, 180.0, 225.0)}
MOTION = {"full": "sway+gesture", "upper": "sway+gesture", "head": "nod+speech"}
FIRST_SIDE = 100_000  # number of the first frame of another side
OFF = {"unseen": "generated", "scale_shrink": 0.0, "weak_smoothness": 0.0, "calm_from": 1.0}
PLAIN, CEILING = "without", "ceiling"
CONTESTANTS: Mapping[str, Mapping[str, Any]] = {
    PLAIN: OFF,
    "edges": OFF,
    "scales": {**OFF, "scale_shrink": TrainSettings().scale_shrink},
    "smoothness": {**OFF, "weak_smoothness": TrainSettings().weak_smoothness},
    "completion": {**OFF, "unseen": "completed"},
    "calm": {**OFF, "calm_from": TrainSettings().calm_from},
    "together": {},
    CEILING: {},
}
"""What is trained: without all of it but the first colours, with each part alone, and with all together."""
MESHES = ("textured mesh", "texture generator")

Shown = Callable[[int, Camera], tuple[Tensor, Tensor]]
"""A frame number and a camera -> colour on black [H, W, 3] and alpha [H, W]."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One contestant at one angle of one mannequin; means over held-out moments."""

    mannequin: str
    fit: str
    contestant: str
    degrees: float
    psnr: float
    shifted: float
    lpips: float


@dataclasses.dataclass(frozen=True)
class Whole:
    """One contestant's numbers that need no truth."""

    mannequin: str
    fit: str
    contestant: str
    gaussians: int
    holes_percent: float
    speckle: float | None


@dataclasses.dataclass(frozen=True)
class Stage:
    """A mannequin before the cameras and the clip that was filmed of it."""

    name: str
    fit: str
    scene: Scene
    clip: FittedClip


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Films, trains and compares."""
    count, size = ("12", "128") if options.quick else ("40", "256")
    defaults = {
        "ingest__mannequin_views": "", "ingest__mannequin_frames": count, "ingest__mannequin_size": size,
        "ingest__test_frames": "2",
    }  # fmt: skip
    names = options.contestants or ("without,together,ceiling" if options.quick else ",".join(CONTESTANTS))
    steps = options.steps or (40 if options.quick else 500)
    sheet: list[np.ndarray] = []
    with frame.settings_of(options, **defaults) as words, tempfile.TemporaryDirectory() as scratch:
        for name in options.mannequins.split(",") if not options.quick else ("head:1",):
            for fit in options.fits.split(",") if not options.quick else ("true",):
                stage, network = prepared(name, fit, words)
                for contestant, shown, whole in contestants(stage, names.split(","), steps, Path(scratch)):
                    if whole is not None:
                        report.add(whole, "whole")
                    rows, strip = compared(stage, contestant, shown, network)
                    for row in rows:
                        report.add(row)
                    sheet.append(strip)
    if options.sheet is not None:
        width = max(strip.shape[1] for strip in sheet)
        wide = [np.pad(strip, ((0, 0), (0, width - strip.shape[1]), (0, 0))) for strip in sheet]
        write_png(options.sheet, np.concatenate(wide))
    return headline(report.tables["rows"])


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    known = "head:1,upper:1,full:1"
    parser.add_argument("--mannequins", default=known, help="FRAMING:IDENTITY, joined by commas")
    parser.add_argument("--fits", default="true,own", help="true, own, joined by a comma")
    parser.add_argument("--contestants", help=f"of {', '.join(CONTESTANTS)}, joined by commas")
    parser.add_argument("--steps", type=int, help="of training; 500, with --quick 40")
    parser.add_argument("--sheet", type=Path, metavar="FILE", help="write pictures there")
    frame.stage_options(parser)


def prepared(name: str, fit: str, words: Mapping[str, str]) -> tuple[Stage, Lpips]:
    """A mannequin, filmed and fitted, and LPIPS."""
    framing, _, identity = name.partition(":")
    subject = f"mannequin_{framing}"
    own = {"ingest.mannequin_motion": MOTION[framing], "ingest.mannequin_identity": identity or "0"}
    job = open_job(subject, parse_request({**own, **words}, subject))
    network = Lpips(frame.asset_folder(job.workspace, "lpips"), "alex")
    return Stage(name, fit, scene_of(job), fitted(job, fit)), network


def scene_of(job: Job) -> Scene:
    """The mannequin before the cameras, the same as ingest filmed."""
    body = load_body(job.workspace.body_file)
    landmarks = load_landmarks(body, job.workspace.body)
    return Filming(mannequin_spec(job.settings["ingest"]), body, landmarks).scene


def fitted(job: Job, fit: str) -> FittedClip:
    """The clip with the pipeline's own fit, or with the true body and poses."""
    if fit == "own":
        made = frame.made(job, "fit")
        return read_fitted_clip(made["ingest"].folder, made["fit"].folder, job.workspace.body_file)
    folder, body = frame.made(job, "ingest")["ingest"].folder, load_body(job.workspace.body_file)
    truth = read_truth(folder, body)
    cameras = dict.fromkeys(truth.poses.frames, scene_of(job).shot.camera)
    split, poses = read_split(folder / "split.json"), truth.poses
    return FittedClip(folder, split, cameras, body, truth.surface, poses, exact(poses.frames))


def exact(frames: Sequence[int]) -> FitQuality:
    """The quality of a fit that is the truth."""
    ones, zeros = np.ones(len(frames)), np.zeros(len(frames))
    return FitQuality(np.asarray(frames, np.int64), ones, ones, zeros, ones, zeros, ones > 0)


def contestants(
    stage: Stage, names: list[str], steps: int, scratch: Path
) -> Iterator[tuple[str, Shown, Whole | None]]:
    """Every contestant, trained, with what it shows."""
    for name in names:
        avatar = trained(stage, name, steps, scratch)
        yield name, shown_by(stage, avatar), whole(stage, name, avatar)
    surface = fine_surface(stage.clip.body, 1)
    seen = gather_colors(surface, stage.clip, stage.clip.spread(12))
    template = surface.refine(stage.clip.body.v_template).numpy()
    for name, colors in zip(
        MESHES, (nearest_known(seen.color, seen.known, template), complete(surface, seen)), strict=True
    ):

        def painted(number: int, camera: Camera, colors: np.ndarray = colors) -> tuple[Tensor, Tensor]:
            image, mask, _ = paint(camera, surface, stage.clip.vertices(number), colors)
            return composite_frame(image, mask), torch.from_numpy(mask).float() / 255

        yield name, painted, None


def trained(stage: Stage, name: str, steps: int, scratch: Path) -> Avatar:
    """A contestant's avatar."""
    edge = 2.5 if steps > 100 else 0.0
    settings = for_bases(
        TrainSettings(iterations=steps, lpips=0.0, edge_pixels=edge, subdivisions=0, **CONTESTANTS[name])
    )
    clip = seen_clip(stage, name, scratch)
    data = TrainingData(clip, clip.cached_views(clip.person_box(settings.crop_margin)), clip.cached_views())
    trainer = build_trainer(data, settings)
    trainer.run()
    settle_unseen(trainer.avatar, trainer.poses, data, settings)
    return trainer.avatar.eval()


def seen_clip(stage: Stage, name: str, scratch: Path) -> FittedClip:
    """The clip as a contestant sees it: without the person's own colours at the edge, or from all sides."""
    clip, folder = stage.clip, scratch / f"{stage.name}_{stage.fit}_{name}".replace(":", "_")
    if CONTESTANTS[name] and name != "edges":
        folder.mkdir()
        for kind in ("frames", "masks"):
            os.symlink(clip.folder / kind, folder / kind)
        (folder / "footage.json").write_bytes((clip.folder / "footage.json").read_bytes())
        return dataclasses.replace(clip, folder=folder)
    return from_all_sides(stage, folder) if name == CEILING else clip


def from_all_sides(stage: Stage, folder: Path) -> FittedClip:
    """The clip with the truth's own pictures of all sides among its training frames."""
    clip, scene = stage.clip, stage.scene
    for kind in ("frames", "masks", FOREGROUND):
        (folder / kind).mkdir(parents=True)
        for path in (clip.folder / kind).iterdir():
            os.symlink(path, folder / kind / path.name)
    (folder / "footage.json").write_bytes((clip.folder / "footage.json").read_bytes())
    cameras, numbers, moments = dict(clip.cameras), [], []
    for place in range(24):
        moment, number = clip.split.train[place * len(clip.split.train) // 24], FIRST_SIDE + place
        camera = around(scene, 360 * place / 24)
        picture = filmed(scene, moment, camera)
        write_frame(folder / "frames", number, picture.image)
        write_mask(folder / "masks", number, picture.mask)
        cameras[number] = camera
        numbers.append(number)
        moments.append(moment)
    write_foreground(folder, numbers, learn=False)
    every = [*clip.poses.frames, *numbers]
    poses = [clip.pose(number) for number in clip.poses.frames] + [clip.pose(moment) for moment in moments]
    split = Split(train=(*clip.split.train, *numbers), test=clip.split.test)
    stacked = type(clip.poses).stack(every, poses)
    return dataclasses.replace(clip, folder=folder, split=split, cameras=cameras, poses=stacked)


def filmed(scene: Scene, number: int, camera: Camera) -> FilmedFrame:
    """One frame of the truth."""
    return film(scene, number, camera, make_background(camera, scene.seed))


def on_black(scene: Scene, number: int, camera: Camera) -> tuple[Tensor, np.ndarray]:
    """The person alone as it was before the camera, on black: [H, W, 3], and its mask [H, W] uint8."""
    picture = film(scene, number, camera, np.zeros((camera.height, camera.width, 3), np.float32))
    return torch.from_numpy(picture.image * (picture.mask > 0)[..., None]).float() / 255, picture.mask


def shown_by(stage: Stage, avatar: Avatar) -> Shown:
    """What an avatar shows."""

    @torch.no_grad()
    def shown(number: int, camera: Camera) -> tuple[Tensor, Tensor]:
        rendering = render(avatar.gaussians(stage.clip.pose(number)), camera)
        return rendering.color.clamp(0, 1), rendering.alpha

    return shown


@torch.no_grad()
def whole(stage: Stage, name: str, avatar: Avatar) -> Whole:
    """An avatar's numbers that need no truth."""
    expression = torch.zeros(stage.clip.poses.expression.shape[1])
    gaussians = avatar.gaussians(Pose(relaxed_pose(1.0), expression, torch.zeros(3)))
    turned = look_around(gaussians, seen_surface(avatar))
    return Whole(stage.name, stage.fit, name, len(gaussians), 100 * turned.holes, turned.speckle)


def compared(stage: Stage, name: str, shown: Shown, network: Lpips) -> tuple[list[Row], np.ndarray]:
    """A contestant's rows, and a strip of pictures above the truth's."""
    rows, strip = [], []
    for degrees in ANGLES:
        scores, camera = [], around(stage.scene, degrees)
        for number in stage.clip.split.test:
            truth, mask = on_black(stage.scene, number, camera)
            image, alpha = shown(number, camera)
            part, moved = box_of(mask).slices, shifted(image, alpha, mask)
            scores.append(
                (
                    psnr(image[part], truth[part]),
                    psnr(moved[part], truth[part]),
                    float(network(image[part], truth[part])),
                )
            )
            if number == stage.clip.split.test[0]:
                both = torch.cat([image, truth]) * 255
                strip.append(both.round().byte().numpy())
        rows.append(Row(stage.name, stage.fit, name, degrees, *np.mean(scores, axis=0).tolist()))
    return rows, np.concatenate(strip, axis=1)


def shifted(image: Tensor, alpha: Tensor, mask: np.ndarray) -> Tensor:
    """A picture moved so that the centre of its alpha lies on the mask's."""
    moments = [cv2.moments(one.astype(np.float32)) for one in (alpha.numpy(), mask)]
    if min(one["m00"] for one in moments) <= 0:
        return image
    (x, y), (to_x, to_y) = ((one["m10"] / one["m00"], one["m01"] / one["m00"]) for one in moments)
    matrix = np.array([[1, 0, to_x - x], [0, 1, to_y - y]], np.float32)
    return torch.from_numpy(cv2.warpAffine(image.numpy(), matrix, image.shape[1::-1]))


def headline(rows: list[dict[str, Any]]) -> str:
    """The gain over what is without all of it, by fit and side, in dB."""
    parts = []
    for fit in dict.fromkeys(row["fit"] for row in rows):
        column = "psnr" if fit == "true" else "shifted"

        def mean(contestant: str, side: str, fit: str = fit, column: str = column) -> float:
            chosen = [
                row[column]
                for row in rows
                if row["fit"] == fit and row["contestant"] == contestant and row["degrees"] in SIDES[side]
            ]
            return float(np.mean(chosen)) if chosen else float("nan")

        for side in SIDES:
            gains = [
                f"{name} {mean(name, side) - mean(PLAIN, side):+.1f}"
                for name in ("together", CEILING, *MESHES)
            ]
            parts.append(f"{fit} {side} {mean(PLAIN, side):.1f} dB, {', '.join(gains)}")
    return "; ".join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("turned", __doc__, measure, arguments, threads=1, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
