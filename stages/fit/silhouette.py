"""The silhouette term: the body's outline against the outlines of the masks, over the whole clip.

Keypoints hold shoulders, trunk and sleeves at a few places, each a few pixels off in every frame. Masks show
where they end. Points on the outline of the posed body are drawn towards the mask's outline, less what clothes
add: how far a segment's outline lies inside the masks in the median over the clip and over both sides of the
body. So clothes widen no body, and a body that stands too far left in one frame moves right.

Head and hands are left out: hair is no part of the body, and both have points enough of their own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from pipeline.body import BodyModel, forward_kinematics, is_part, rest_vertices
from pipeline.body.identity import Identity
from pipeline.body.rasterize import rasterize
from pipeline.body.skinning import blend_transforms, transform_points
from pipeline.clip.camera import Camera
from pipeline.clip.frames import read_mask
from stages.fit.camera_batch import CameraBatch
from stages.fit.parameters import Parameters
from stages.fit.terms import outline_loss

POINTS = 64  # of each frame's outline
BEGIN, EVERY = 0.5, 0.1  # of the iterations: when the term sets in, how often outlines are found anew
SATURATION = 20.0  # of a distance, pixels of a picture of LONG_SIDE
_FIELD_SIDE, _DRAWN_SIDE = 128, 256  # pixels: of distance fields, of the drawings that outlines are read from
_MARGIN = 3  # pixels at the picture's border, where a silhouette ends without an outline
_REACH = 60.0  # pixels of a picture of LONG_SIDE beyond which distances are not told apart
_LEAST = 30  # outline points of a segment from which its clothes are told
LONG_SIDE = 512.0


@dataclasses.dataclass(frozen=True)
class DistanceFields:
    """Signed distances to the masks' outlines, T frames.

    Attributes:
        distance: [T, h, w] float16, negative inside the mask, pixels of a picture whose long side is 512.
    """

    distance: Tensor

    def sample(self, pixels: Tensor, size: Tensor, rows: slice = slice(None)) -> Tensor:
        """Distances at pixels [T, P, 2] of frames of ``size`` [T, 2]: [T, P]."""
        field = self.distance[rows].float()[:, None]
        places = 2 * pixels / size[:, None] - 1
        kind = {"mode": "bilinear", "padding_mode": "border", "align_corners": False}
        return functional.grid_sample(field, places[:, :, None], **kind)[:, 0, :, 0]


def read_fields(masks: Path, frames: Sequence[int]) -> DistanceFields:
    """The distance fields of a clip's masks."""
    return DistanceFields(torch.stack([signed_distance(read_mask(masks, frame)) for frame in frames]))


def signed_distance(mask: np.ndarray) -> Tensor:
    """The distance to a mask's outline, [H, W] uint8 -> [h, w] float16, as ``DistanceFields`` has it."""
    inside = (mask > 127).astype(np.uint8)
    out, into = (cv2.distanceTransform(part, cv2.DIST_L2, 5) for part in (1 - inside, inside))
    if not inside.any() or inside.all():
        out, into = np.zeros_like(out), np.zeros_like(into)
    away = np.where(inside > 0, 0.5 - into, out - 0.5) * (LONG_SIDE / max(mask.shape))
    size = (_FIELD_SIDE, _FIELD_SIDE)  # whatever the picture's form, so that cameras of a rig stack
    small = cv2.resize(away.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.clip(small, -_REACH, _REACH)).half()


@dataclasses.dataclass(frozen=True)
class Outlines:
    """Points on the outline of the posed body, T frames and P points.

    Attributes:
        vertices: [T, P] int64, of the body.
        weight: [T, P], 0 where there is no point.
        clothes: [T, P], how far the mask's outline lies outside the body's there, pixels of 512.
    """

    vertices: Tensor
    weight: Tensor
    clothes: Tensor


class Silhouette:
    """The term, with the outlines that were found last."""

    def __init__(
        self,
        body: BodyModel,
        fields: DistanceFields,
        cameras: Sequence[Camera],
        views: CameraBatch,
        betas: int,
        seen: np.ndarray,  # [T, V] bool, whether a trusted keypoint speaks for the vertex's part
    ) -> None:
        """Prepare what does not change; no outline is known yet."""
        self.body, self.fields, self.cameras, self.views, self.seen = body, fields, cameras, views, seen
        self.shape = body.shape_directions[..., :betas]
        self.segment = segments(body)
        self.usable = ~is_part(body, "head", "face", "left_hand", "right_hand").numpy()
        self.outlines: Outlines | None = None

    def find(self, parameters: Parameters, matrices: Tensor) -> None:
        """Find the outlines of the body as it is posed now."""
        with torch.no_grad():
            every = torch.arange(len(self.body.v_template)).expand(1, -1)
            rows = [
                self._outline(t, self._posed(parameters.rows(t, t + 1), matrices[t : t + 1], every)[0])
                for t in range(len(matrices))
            ]
            vertices, weight = (torch.stack(parts) for parts in zip(*rows, strict=True))
            placed = self._posed(parameters, matrices, vertices)
            distance = self._distance(placed, slice(None))
        clothes = segment_medians(-distance, self.segment[vertices], weight > 0)
        self.outlines = Outlines(vertices, weight, clothes)

    def loss(self, parameters: Parameters, matrices: Tensor, rows: slice) -> Tensor:
        """The term of some frames, [W]; zero before outlines were found."""
        if self.outlines is None:
            return parameters.transl.new_zeros(len(matrices))
        vertices, weight = self.outlines.vertices[rows], self.outlines.weight[rows]
        distance = self._distance(self._posed(parameters, matrices, vertices), rows)
        loss = outline_loss(distance + self.outlines.clothes[rows], SATURATION)
        return (loss * weight).sum(1)

    def _posed(self, parameters: Parameters, matrices: Tensor, vertices: Tensor) -> Tensor:
        """Vertices of the body in the world, [T, P] -> [T, P, 3] metres."""
        body = self.body
        rest = body.v_template + self.shape @ parameters.betas
        joints = body.joint_regressor @ rest + parameters.joint_offset
        transforms, _ = forward_kinematics(matrices, joints, body.parents)
        blended = blend_transforms(transforms, body.skinning_weights[vertices])
        return transform_points(blended, rest[vertices]) + parameters.transl[:, None]

    def _distance(self, points: Tensor, rows: slice) -> Tensor:
        """Signed distances of points to the masks' outlines, [T, P, 3] -> [T, P]."""
        views = self.views.rows(rows)
        return self.fields.sample(views.to_pixels(views.to_camera(points)), views.size, rows)

    def _outline(self, row: int, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices on a frame's outline and their weights, [P] both."""
        camera, faces = self.cameras[row], self.body.faces.numpy()
        scale = min(1.0, _DRAWN_SIDE / max(camera.width, camera.height))
        small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        drawn = rasterize(small, vertices, self.body.faces)
        edge = drawn.covered & ~cv2.erode(drawn.covered.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        edge[:_MARGIN], edge[-_MARGIN:], edge[:, :_MARGIN], edge[:, -_MARGIN:] = (False,) * 4
        corner = drawn.barycentrics[edge].argmax(-1)
        found = faces[drawn.face[edge], corner]
        found = found[self.usable[found] & self.seen[row, found]]
        chosen = torch.zeros(POINTS, dtype=torch.int64)
        weight = torch.zeros(POINTS)
        picked = found[np.linspace(0, len(found) - 1, min(POINTS, len(found))).round().astype(int)] if len(found) else found
        chosen[: len(picked)], weight[: len(picked)] = torch.from_numpy(picked.astype(np.int64)), 1.0
        return chosen, weight


def segments(body: BodyModel) -> Tensor:
    """A number for each vertex's joint, one for left and right: [V] int64."""
    names = [name.removeprefix("left_").removeprefix("right_") for name in body.joint_names]
    number = torch.tensor([names.index(name) for name in names])
    return number[body.skinning_weights.argmax(1)]


def segment_medians(values: Tensor, segment: Tensor, there: Tensor) -> Tensor:
    """The median of each point's segment over all points that are there, at least 0: [T, P] -> [T, P]."""
    found = torch.zeros_like(values)
    for number in torch.unique(segment[there]).tolist():
        chosen = there & (segment == number)
        if int(chosen.sum()) >= _LEAST:
            found[segment == number] = values[chosen].median().clamp_min(0)
    return found
