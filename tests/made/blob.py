"""A tiny subject for the evaluate stage: a blob of Gaussians, filmed by the renderer itself."""

import dataclasses
from pathlib import Path

import numpy as np
import torch

from pipeline.body import Poses, mean_identity, write_poses
from pipeline.clip.camera import facing_camera
from pipeline.clip.curves import Curve
from pipeline.clip.keypoints import FACE, LEFT_HAND, empty_keypoints
from pipeline.clip.records import Footage, Split
from pipeline.files.json_files import write_json
from pipeline.files.tables import write_table
from pipeline.splat import Gaussians, render
from stages.evaluate.evaluated_clip import read_evaluated_clip
from stages.evaluate.frame_metrics import Scorer
from stages.evaluate.run import evaluate
from stages.evaluate.settings import EvaluateSettings
from stages.fit.run import RESIDUALS_SCHEMA as RESIDUALS
from stages.train.visibility_gate import write_visibility
from tests.made.body import open_body
from tests.made.context import RecordedContext, stage_context
from tests.made.plans import plan_of
from tests.made.published import publish

FRAMES = tuple(range(0, 24, 2))  # every second frame of the source was kept
TEST = FRAMES[-3:]
WIDTH, HEIGHT = 64, 48

OPTIONAL = ("mesh", "second", "embedder", "arcface", "other_cameras", "rig", "packed")


def stand_in(pose, time):
    """A blob of 40 Gaussians that follows ``transl`` and leans with the root's rotation."""
    transl = pose.transl
    generator = torch.Generator().manual_seed(7)
    draw = torch.rand(40, 3, generator=generator)
    means = (draw - 0.5) * torch.tensor([0.6, 0.8, 0.3]) + transl
    means = means + torch.linalg.cross(pose.rotation[:1].expand(40, 3), means - transl)
    quaternions = torch.tensor([[1.0, 0, 0, 0]]).expand(40, 4)
    scales = torch.full((40, 3), 0.09)
    return Gaussians(
        means, quaternions, scales, torch.rand(40, 3, generator=generator), torch.full((40,), 0.99)
    )


def wrong(pose, time):
    """The same blob in other colours."""
    right = stand_in(pose, time)
    return dataclasses.replace(right, colors=1 - right.colors)


def moving_poses(shift=0.0):
    count = len(FRAMES)
    transl = torch.tensor([0.0, 0.0, -2.0]).repeat(count, 1)
    transl[:, 0] = torch.linspace(-0.2, 0.3, count) + shift
    rotation = torch.zeros(count, 55, 3)
    rotation[:, 0, 2] = torch.linspace(0, 0.3, count)
    return Poses(FRAMES, rotation, torch.zeros(count, 4), transl)


@dataclasses.dataclass
class FilmedBlob:
    """A subject as the upstream stages publish it, filmed of the stand-in avatar."""

    root: Path
    inputs: dict[str, Path]

    def context(self, name="out", **settings) -> RecordedContext:
        small = {"turntable_frames": 4, "turntable_width": 48, "turntable_height": 64, "motion_frames": 4}
        settings = EvaluateSettings(lpips_networks=(), **{**small, **settings})
        return stage_context("evaluate", settings, self.root / name, self.inputs, subject="blob")

    def clip(self):
        return read_evaluated_clip(self.inputs, open_body())

    def evaluate(self, animate=stand_in, name="out", follow=None, **arguments):
        """``arguments``: those of ``evaluate`` by their names; all others are settings."""
        optional = {key: arguments.pop(key) for key in OPTIONAL if key in arguments}
        context = self.context(name, **arguments)
        choices = context.settings.choices
        scorer = Scorer({}, choices.background, choices.render_mask)
        evaluate(context, self.clip(), animate, follow or animate, scorer, **optional)
        return context.output


def a_face_and_a_hand():
    """Keypoints of a face 20 pixels wide about the picture's middle in all frames, and of a hand in one."""
    keypoints = empty_keypoints(np.array(FRAMES))
    spread = np.random.default_rng(0).uniform(-10, 10, (68, 2))
    keypoints.whole_body[:, FACE, :2] = np.array([WIDTH / 2, HEIGHT / 2]) + spread
    keypoints.whole_body[:, FACE, 2] = 0.9
    keypoints.whole_body[FRAMES.index(TEST[0]), LEFT_HAND] = [30, 20, 0.8]
    keypoints.whole_body[FRAMES.index(TEST[0]), LEFT_HAND, :2] += spread[:21]
    return keypoints


def filmed(soft: bool):
    """Frame and mask of each pose, [H, W, 3] and [H, W] uint8; ``soft`` as of ``make_clip``."""
    camera, poses = facing_camera(WIDTH, HEIGHT, 70.0), moving_poses()
    for frame in FRAMES:
        rendering = render(stand_in(poses.pose(frame), None), camera)
        alpha = rendering.alpha if soft else (rendering.alpha > 0).float()
        color = rendering.color / rendering.alpha[..., None].clamp(min=1e-6) if soft else rendering.color
        yield (color.clamp(0, 1) * 255).round().byte().numpy(), (alpha * 255).round().byte().numpy()


def make_clip(root: Path, test=TEST, soft: bool = False) -> FilmedBlob:
    """``soft``: masks are the alpha, and frames show the blob's colour undimmed. Else hard masks."""
    dropped = {"no person was found": 2, "unreadable": 0}
    seconds = tuple(frame / 25 for frame in FRAMES)
    inputs = publish(
        root,
        filmed(soft),
        dict.fromkeys(FRAMES, facing_camera(WIDTH, HEIGHT, 70.0)),
        (open_body(), mean_identity(open_body()), moving_poses()),
        Footage("blob.mp4", 128, 96, 25.0, 0.5, 14, 12, dropped, 2, seconds, {"masks": "made"}),
        Split(tuple(frame for frame in FRAMES if frame not in test), test),
        a_face_and_a_hand(),
        plan_of(pose_heads=False, test_time_refinement=False),
    )
    fit, train = inputs["fit"], root / "train"
    train.mkdir()
    write_poses(train / "poses.parquet", moving_poses())
    errors = {"frame": np.array(FRAMES[:2], np.int32), "group": np.array(["body", "face"], dtype=object)}
    pixels = {"point": np.zeros(2, np.int32), "pixels": np.array([1.0, 3.0], np.float32)}
    write_table(fit / "residuals.parquet", RESIDUALS, errors | pixels)
    points = Curve()
    for iteration in (10, 20, 30):
        points.count({"l1": 1 / iteration, "ssim": 0.5 / iteration, "offset": 1e-3, "pose_offset": 1e-4})
        points.point(iteration, {"psnr": 20.0 + iteration, "gaussians": 40.0, "learning_rate": 1e-3})
    points.write(train / "curve.parquet")
    registration = Curve([(0, "pixels", 20.0), (50, "pixels", 2.0)])
    registration.write(fit / "curve.parquet")
    kept = np.arange(50) < 40
    write_visibility(
        train / "visibility.parquet", captured=kept * 1.0, generated=kept * 0.0, early=~kept, kept=kept
    )
    write_json(train / "gate.json", {"tau": 0.5, "why": "20% of the body is under 0.50", "definition": "x"})
    return FilmedBlob(root, {**inputs, "train": train})
