"""The error of masks against mannequins' truth before cluttered backgrounds, each witness alone and fused.

Holds: docs/results.md, "Masks". Mannequins of 512 pixels stand before clutter with colours near theirs. Of
each picture alone, without a background learnt from others and without steadying:

- IoU, cut at one half; the mean error of alpha within 4 pixels of the true outline;
- hands and feet: the share of their true pixels that the mask has;
- spill: what it has more than 4 pixels outside, of the person's area;
- processor milliseconds, for what is more than MediaPipe's one pass.

``fused`` is what ingest makes of MediaPipe's two, ``parts`` adds hands and feet (``ingest.mask_parts``), and
``three`` fuses U2-Net's mask of the person's box as well, which ingest does not (docs/tried.md).
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks import frame
from benchmarks.fit_truth import Stage, load_stage
from pipeline.body import pose_body, rasterize
from pipeline.body.joints import joint_index
from pipeline.body.parts import PARTS, part_labels
from pipeline.clip.background import log_odds
from pipeline.clip.keypoints import BODY
from pipeline.config.workspace import open_workspace
from pipeline.detection.mediapipe import Estimate, Estimator, estimator_scale, resize
from pipeline.detection.u2net import SaliencyModel
from pipeline.detection.wholebody import to_keypoints, to_pixels
from stages.ingest.mannequin import MannequinSpec
from stages.ingest.mannequin.footage import Filming
from stages.ingest.mannequin.scene import film
from stages.ingest.mask_edges import follow_edges
from stages.ingest.mask_parts import complete_parts
from stages.ingest.masks import SEED_SCORE, SHARPEN, fill_holes, fuse, main_component, overlap, selfie_share

SIDE, FRAMES, EVERY = 512, 48, 12
CLIPS = (
    ("full", "sway+curl"), ("full", "turn+gesture+curl+speech"), ("upper", "sway+gesture+curl"),
    ("full", "sway"),
)  # fmt: skip
_FEET = ("left_ankle", "right_ankle", "left_foot", "right_foot")
_BAND = 9  # pixels, 4 on either side of the outline
_THIRD, _MARGIN = 0.3, 0.12  # U2-Net's share of the log-odds; of the person's extent, around its box


@dataclasses.dataclass(frozen=True)
class Picture:
    """One picture, its truth, and what was found in it; masks [H, W] in [0, 1]."""

    image: np.ndarray
    true: np.ndarray
    hands: np.ndarray
    feet: np.ndarray
    points: np.ndarray
    body: np.ndarray
    selfie: np.ndarray


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Films, masks and measures every clip; the means of each way."""
    stage, workspace = load_stage(), open_workspace(assets=options.assets)
    asset = frame.asset_folder(workspace, "mediapipe")
    saliency = SaliencyModel(frame.asset_folder(workspace, "u2netp"))
    found: dict[str, list[dict[str, float]]] = {}
    for number, (framing, motion) in enumerate(CLIPS[: 1 if options.quick else None]):
        for dark in (False, True):
            spec = MannequinSpec(
                framing=framing, motion=motion, frames=FRAMES, size=SIDE, identity=3 + number, seed=number
            )
            pictures = list(detected(stage, spec, clutter(number, dark), asset))
            share = selfie_share([overlap(one.body, one.selfie) for one in pictures])
            for picture in pictures[: 2 if options.quick else None]:
                for name, way in ways(share, saliency).items():
                    started = time.process_time()
                    mask = way(picture)
                    cost = 1e3 * (time.process_time() - started)
                    found.setdefault(name, []).append(errors(mask, picture) | {"ms": cost})
    rows = {name: _means(many) for name, many in found.items()}
    for name, row in rows.items():
        report.add({"mask": name, **row})
    before, after = rows["fused"], rows["parts"]
    return (
        f"hands {before['hands']:.3f} to {after['hands']:.3f}, "
        f"feet {before['feet']:.3f} to {after['feet']:.3f}, IoU {before['iou']:.4f} to "
        f"{after['iou']:.4f} for {after['ms'] - before['ms']:.0f} ms a picture"
    )


def ways(share: float, saliency: SaliencyModel) -> dict[str, Callable[[Picture], np.ndarray]]:
    """Name -> what makes a mask of a picture."""

    def two(one: Picture) -> np.ndarray:
        return fuse(one.body, one.selfie, share)

    def third(one: Picture) -> np.ndarray:
        box = _box(one)
        whole = np.zeros_like(one.body)
        whole[box] = saliency(np.ascontiguousarray(one.image[box]))
        return whole

    def three(one: Picture) -> np.ndarray:
        odds = (1 - _THIRD) * log_odds(two(one)) + _THIRD * log_odds(third(one))
        return (1 / (1 + np.exp(-odds))).astype(np.float32)

    return {
        "pose model": lambda one: one.body,
        "selfie": lambda one: one.selfie,
        "U2-Net": third,
        "fused": lambda one: cleaned(two(one), one, parts=False),
        "parts": lambda one: cleaned(two(one), one, parts=True),
        "three": lambda one: cleaned(three(one), one, parts=False),
        "three, parts": lambda one: cleaned(three(one), one, parts=True),
    }


def cleaned(alpha: np.ndarray, one: Picture, parts: bool) -> np.ndarray:
    """A fused mask as ingest cleans it, but for what it learns from other frames."""
    body = one.points[BODY]
    alpha = fill_holes(main_component(alpha, body[body[:, 2] >= SEED_SCORE, :2]))
    alpha = follow_edges(alpha, one.image, 1.0)
    if parts:
        alpha = complete_parts(alpha, one.image, one.points)
    return np.clip((alpha - 0.5) * SHARPEN + 0.5, 0, 1)


def detected(stage: Stage, spec: MannequinSpec, background: np.ndarray, asset: Path) -> Iterator[Picture]:
    """Some frames of a clip before a background, with what MediaPipe finds in them."""
    filming = Filming(spec, stage.body, stage.landmarks)
    scene, camera = filming.scene, filming.scene.shot.camera
    leads = stage.body.skinning_weights.argmax(1)[stage.body.faces[:, 0]].numpy()
    parts = part_labels(stage.body)[stage.body.faces[:, 0]].numpy()
    hands = [PARTS.index(name) for name in ("left_hand", "right_hand")]
    feet = [joint_index(name) for name in _FEET]
    with tempfile.TemporaryDirectory() as folder:
        estimator = Estimator(asset, Path(folder) / "mediapipe.log", still=True)
        for row in range(0, spec.frames, EVERY):
            filmed, pose = film(scene, row, camera, background), scene.shot.poses
            estimate = estimator.estimate(resize(filmed.image, estimator_scale(SIDE, SIDE, 400, 1920)))
            if estimate is None:
                continue
            vertices, _ = pose_body(
                stage.body, scene.clothed, pose.rotation[row, None], pose.expression[row, None],
                pose.transl[row, None],
            )  # fmt: skip
            raster = rasterize(camera, vertices[0], stage.body.faces)
            inside = raster.covered & (filmed.mask > 127)
            yield Picture(
                filmed.image, filmed.mask / np.float32(255), inside & np.isin(parts[raster.face], hands),
                inside & np.isin(leads[raster.face], feet), _points(estimate),
                *(cv2.resize(m, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
                  for m in (estimate.body_mask, estimate.selfie_mask)),
            )  # fmt: skip


def _points(estimate: Estimate) -> np.ndarray:
    landmarks = [to_pixels(estimate, SIDE, SIDE)]
    return to_keypoints(np.zeros(1, np.int64), landmarks, SIDE, SIDE, 1.0).whole_body[0]


def clutter(seed: int, dark: bool) -> np.ndarray:
    """Furniture, patterns and grain, in colours that people have too: [H, W, 3] float32 in 0 to 255."""
    rng = np.random.default_rng([seed, int(dark)])
    picture = np.full((SIDE, SIDE, 3), rng.uniform(20, 70) if dark else rng.uniform(120, 200), np.float32)
    for _ in range(60):
        x, y, wide, high = (*rng.integers(0, SIDE, 2), *rng.integers(10, 160, 2))
        thing = picture[y : y + high, x : x + wide]
        thing[:] = 0.4 * thing + 0.6 * rng.uniform(0, 130 if dark else 255, 3)
    for size in (1, 4, 16):
        grain = rng.normal(0, 12, (SIDE // size, SIDE // size, 3)).astype(np.float32)
        picture += cv2.resize(grain, (SIDE, SIDE))
    return cv2.GaussianBlur(np.clip(picture, 0, 255), (0, 0), 1.0)


def _box(one: Picture) -> tuple[slice, slice]:
    """Where U2-Net looks: around the pose model's mask and the points that were found."""
    inside = one.body > 0.3
    rows, columns = np.nonzero(inside)
    places = np.stack([columns, rows], axis=1)
    seen = one.points[(one.points[:, 2] >= SEED_SCORE), :2]
    low, high = (getattr(np.concatenate([places, seen]), name)(0) for name in ("min", "max"))
    more = _MARGIN * (high - low).max()
    low, high = (np.clip(edge, 0, SIDE).astype(int) for edge in (low - more, high + more + 1))
    return slice(low[1], high[1]), slice(low[0], high[0])


def errors(mask: np.ndarray, one: Picture) -> dict[str, float]:
    """What the module's text names, of one mask; NaN where a picture shows no hand or foot."""
    true, found = one.true > 0.5, mask > 0.5
    kernel = np.ones((_BAND, _BAND), np.uint8)
    near = cv2.dilate(true.astype(np.uint8), kernel) > 0
    band = near & ~(cv2.erode(true.astype(np.uint8), kernel) > 0)
    share = {
        name: float((found & part).sum() / part.sum()) if part.sum() > 30 else float("nan")
        for name, part in (("hands", one.hands), ("feet", one.feet))
    }
    return {
        "iou": float((true & found).sum() / (true | found).sum()),
        "band": float(np.abs(mask - one.true)[band].mean()),
        **share,
        "spill": float((found & ~near).sum() / true.sum()),
    }


def _means(many: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.nanmean([one[name] for one in many])) for name in many[0]}


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--assets", type=Path, metavar="DIR", help="where fetched weights lie")


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("masks", __doc__, measure, arguments, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
