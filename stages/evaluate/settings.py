"""What the evaluate stage can be told. What a metric means is the protocol's three choices; see there."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from pipeline.config import evaluation_protocol as protocols
from pipeline.config.choices import (
    Background,
    EdgeColors,
    LpipsNetwork,
    PlyUp,
    ProtocolName,
    Refinement,
    RenderMask,
)
from pipeline.config.evaluation_protocol import Protocol
from pipeline.config.settings import (
    SETTINGS,
    Angle,
    Count,
    CountOrNone,
    EvenSide,
    FrameRate,
    Frames,
    FramesOrNone,
    NotEmpty,
    Positive,
    Seed,
    Weight,
    setting,
)  # fmt: skip

Rounds = Annotated[int, Field(ge=1, le=1_000_000)]
Share = Annotated[float, Field(gt=0, lt=1)]
ShareOrNone = Annotated[float, Field(ge=0, le=100)]
TextureSide = Annotated[int, Field(ge=16, le=8192)]
Auto = Literal["auto"]


@dataclass(frozen=True, config=SETTINGS)
class EvaluateSettings:
    """Settings of the evaluate stage; frames of which there are several are evenly spaced."""

    # Sets of the four choices below it: paper is NeuMan's (white, the truth's mask on both pictures, test
    # poses refined), paper_black that of its other tables (black, the truth's mask on both).
    protocol: ProtocolName = setting(
        "ours", "a named set of choices, see pipeline/config/evaluation_protocol.py"
    )
    background: Literal[Auto, Background] = setting(
        "auto", "what avatar, truth and baselines are composited on; auto: as the protocol says"
    )
    render_mask: Literal[Auto, RenderMask] = setting(
        "auto", "whose mask cuts the avatar's picture out: its own alpha, or the truth's on both pictures"
    )
    refine_test_poses: Literal[Auto, Refinement] = setting(
        "auto", "score held-out frames at poses refined on them too; plan: as it decided"
    )
    edge_colors: Literal[Auto, EdgeColors] = setting(
        "auto",
        "the truth's colours where its mask is soft: the person's own, or the photograph's, wall and all; "
        "auto: as the protocol says",
    )
    refine_steps: Rounds = setting(60, "steps of that refinement, a frame")
    refine_share: ShareOrNone = setting(
        0.2, "what it may cost where nothing asks for it, of training's steps times pixels; 0: nothing"
    )
    refine_lpips: Weight = setting(0.0, "weight of LPIPS in it, beside 0.8 L1 and 0.2 SSIM")
    refine_lpips_network: LpipsNetwork = setting("vgg", "its backbone")
    lpips_networks: tuple[LpipsNetwork, ...] = setting(
        ("alex",), "backbones of LPIPS; on a CPU VGG costs twenty times what AlexNet does"
    )
    training_frames: Count = setting(8, "training frames that are scored too, to show what is remembered")
    baseline_frames: CountOrNone = setting(400, "training frames that the baselines draw from; 0: all")
    mesh_frames: CountOrNone = setting(
        12, "training frames that give the textured mesh, a baseline, its colours; 0: without it"
    )
    # independent is U2-Net's and estimator MediaPipe's own, frame by frame; each needs its asset.
    second_mask: NotEmpty = setting(
        "independent",
        "what the ceiling is measured with: independent, edge (the mask, a pixel smaller), estimator, off, "
        "or a folder of grey pictures named by frame number",
    )
    second_mask_frames: CountOrNone = setting(12, "held-out frames that it is measured on; 0: all")
    identity: bool = setting(
        False, "compare faces by dlib's embedding: needs the assets dlib and identity, 0.15 s a picture"
    )
    arcface: str = setting(
        "", "ArcFace's ONNX file (112 x 112 pixels to 512 numbers): faces are compared as the paper does"
    )
    bootstrap_rounds: Rounds = setting(2000, "samples that are drawn for the intervals")
    bootstrap_seed: Seed = setting(0, "of those draws")
    confidence: Share = setting(0.95, "share of the drawn means that lie inside an interval")
    comparison_frames: Frames = setting(3, "held-out frames in comparison.png")
    slider_frames: FramesOrNone = setting(
        12, "held-out frames in the report's slider; each adds about 40 KB at 512 pixels"
    )
    error_gain: Positive = setting(3.0, "what the error picture is multiplied by")
    turntable_frames: Frames = setting(90, "frames of the turn")
    turntable_width: EvenSide = setting(480, "pixels of the turn")
    turntable_height: EvenSide = setting(640, "pixels of the turn")
    turntable_fps: FrameRate = setting(30.0, "frames a second of the turn, and of the motion")
    ply_up: PlyUp = setting("-y", "the axis that points up in avatar.ply; most viewers show -y upright")
    glb_texture: TextureSide = setting(1024, "pixels of the side of avatar.glb's texture")
    arm_angle: Angle = setting(1.0, "how far the arms hang below the T pose in the turn, radians")
    motion_frames: FramesOrNone = setting(
        48, "frames of a motion that was never filmed (arms up, head turned); 0: without it"
    )

    interactive: bool = setting(
        True,
        "the avatar itself in report.html and avatar.html, to be turned and posed: 1 to 4 MB each",
    )

    @property
    def choices(self) -> Protocol:
        """What the protocol and the settings say together."""
        return protocols.chosen(dataclasses.asdict(self))

    @property
    def assets(self) -> tuple[str, ...]:
        """The assets that these settings call for."""
        witness = {"estimator": ("mediapipe",), "independent": ("u2netp",)}.get(self.second_mask, ())
        return ("lpips", *witness, *(("dlib", "identity") if self.identity else ()))
