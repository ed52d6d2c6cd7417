"""The silhouette term: the body's outline against the outlines of the masks, over the whole clip.

Keypoints hold shoulders, trunk and sleeves at a few places, each a few pixels off in every frame. Masks
show where they end. Points on the outline of the posed body are drawn towards the mask's outline, less what
clothes add: how far a segment's outline lies inside the masks in the median over the clip and over both sides
of the body. So clothes widen no body, and a body that stands too far left in one frame moves right.

Head and hands are left out: hair is no part of the body, and both have points enough of their own. Limbs that
no keypoint speaks for neither count nor turn.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from pipeline.body import (
    PARTS,
    BodyModel,
    blend_transforms,
    forward_kinematics,
    part_labels,
    rasterize,
    transform_points,
)
from pipeline.body.parts import joint_parts
from pipeline.clip.camera import Camera
from pipeline.clip.frames import read_mask
from stages.fit.camera_batch import CameraBatch
from stages.fit.parameters import Parameters
from stages.fit.terms import LONG_SIDE, outline_loss

POINTS = 64  # of each frame's outline
BEGIN, EVERY = 0.5, 0.1  # of the iterations: when the term sets in, how often outlines are found anew
SATURATION = 20.0  # of a distance, pixels of a picture of LONG_SIDE
_LEFT_OUT = ("head", "face", "left_hand", "right_hand")
_FIELD_SIDE, _DRAWN_SIDE = 128, 256  # pixels: of distance fields, of the drawings that outlines are read from
_MARGIN = 3  # pixels at a drawing's border, where a silhouette ends without an outline
_REACH = 60.0  # pixels of a picture of LONG_SIDE beyond which distances are not told apart
_LEAST = 30  # outline points of a segment from which its clothes are told


@dataclasses.dataclass(frozen=True)
class DistanceFields:
    """Signed distances to the masks' outlines, T frames.

    Attributes:
        distance: [T, S, S] float16, over the whole picture whatever its form; negative inside the mask,
            pixels of a picture whose long side is ``LONG_SIDE``.
    """

    distance: Tensor

    def sample(self, pixels: Tensor, size: Tensor, rows: slice) -> Tensor:
        """Distances at pixels [T, P, 2] of frames ``rows``, whose sizes are [T, 2]: [T, P]."""
        field = self.distance[rows].to(pixels.dtype)[:, None]
        places = 2 * pixels / size[:, None] - 1
        found = functional.grid_sample(field, places[:, :, None], padding_mode="border", align_corners=False)
        return found[:, 0, :, 0]


def read_fields(masks: Path, frames: Sequence[int]) -> DistanceFields:
    """The distance fields of a clip's masks."""
    return DistanceFields(torch.stack([signed_distance(read_mask(masks, frame)) for frame in frames]))


def signed_distance(mask: np.ndarray) -> Tensor:
    """The distance to a mask's outline, [H, W] uint8 -> [S, S] float16, see ``DistanceFields``.

    Zero everywhere in a picture without an outline.
    """
    inside = (mask > 127).astype(np.uint8)
    if not inside.any() or inside.all():
        return torch.zeros(_FIELD_SIDE, _FIELD_SIDE, dtype=torch.float16)
    out, into = (
        cv2.distanceTransform(part, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for part in (1 - inside, inside)
    )
    away = np.where(inside > 0, 0.5 - into, out - 0.5).astype(np.float32) * (LONG_SIDE / max(mask.shape))
    small = cv2.resize(away, (_FIELD_SIDE, _FIELD_SIDE), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.clip(small, -_REACH, _REACH)).half()


@dataclasses.dataclass(frozen=True)
class Outlines:
    """Points on the outline of the posed body, T frames and P points.

    Attributes:
        vertices: [T, P] int64, of the body.
        weight: [T, P], 0 where there is no point.
        clothes: [T, P], how far the mask's outline lies outside the body's there, pixels of LONG_SIDE.
    """

    vertices: Tensor
    weight: Tensor
    clothes: Tensor


class Silhouette:
    """The term of a clip, with the outlines that were found last."""

    def __init__(
        self,
        body: BodyModel,
        fields: DistanceFields,
        cameras: Sequence[Camera],
        views: CameraBatch,
        betas: int,
        counted: np.ndarray,
    ) -> None:
        """Prepare what does not change; no outline is known yet.

        Args:
            body: the body.
            fields: of T frames, of which ``cameras`` and ``views`` are.
            betas: how many shape coefficients are fitted.
            counted: [T, PARTS] bool, the parts that a trusted keypoint speaks for.
        """
        self.body, self.fields, self.cameras, self.views = body, fields, cameras, views
        self.shape = body.shape_directions[..., :betas]
        self.segment, self.part = segments(body), part_labels(body).numpy()
        self.counted = counted & ~np.isin(PARTS, _LEFT_OUT)
        self.held = torch.from_numpy(self.counted[:, joint_parts().numpy()])[..., None, None]
        self.outlines: Outlines | None = None

    @staticmethod
    def steps(iterations: int) -> frozenset[int]:
        """The steps before which outlines are to be found."""
        return frozenset(round(share * iterations) for share in np.arange(BEGIN, 1.0, EVERY))

    def find(self, parameters: Parameters, matrices: Tensor) -> None:
        """Find the outlines of the body as it is posed now; arguments as for ``loss``, of all frames."""
        every = torch.arange(len(self.part))[None]
        with torch.no_grad():
            found, at_rest = [], self._at_rest(parameters)
            for row in range(len(matrices)):
                of_frame = parameters.rows(row, row + 1)
                vertices = self._posed(of_frame, matrices[row : row + 1], every, at_rest)[0]
                found.append(self._outline(row, vertices))
            vertices, weight = (torch.stack(parts) for parts in zip(*found, strict=True))
            distance = self._distance(self._posed(parameters, matrices, vertices, at_rest), slice(None))
        clothes = segment_medians(-distance, self.segment[vertices], weight > 0)
        self.outlines = Outlines(vertices, weight, clothes)

    def loss(self, parameters: Parameters, matrices: Tensor, rows: slice) -> Tensor:
        """The term of some frames, [W]; zero before outlines were found.

        Args:
            parameters: of these frames; everything but the pose is read from there.
            matrices: theta, [W, 55, 3, 3].
            rows: which frames of the clip they are.
        """
        if self.outlines is None:
            return parameters.transl.new_zeros(len(matrices))
        vertices, weight = self.outlines.vertices[rows], self.outlines.weight[rows]
        # A shoulder's outline would else swing an arm that nobody sees.
        matrices = torch.where(self.held[rows], matrices, matrices.detach())
        posed = self._posed(parameters, matrices, vertices, self._at_rest(parameters))
        distance = self._distance(posed, rows)
        return (outline_loss(distance + self.outlines.clothes[rows], SATURATION) * weight).sum(1)

    def _at_rest(self, parameters: Parameters) -> tuple[Tensor, Tensor]:
        """Vertices [V, 3] and joints [55, 3] of the T pose, metres; the same in every frame."""
        rest = self.body.v_template + self.shape @ parameters.betas
        return rest, self.body.joint_regressor @ rest + parameters.joint_offset

    def _posed(
        self, parameters: Parameters, matrices: Tensor, vertices: Tensor, at_rest: tuple[Tensor, Tensor]
    ) -> Tensor:
        """Vertices of the body in the world, [T, P] -> [T, P, 3] metres."""
        body, (rest, joints) = self.body, at_rest
        transforms, _ = forward_kinematics(matrices, joints, body.parents)
        blended = blend_transforms(transforms, body.skinning_weights[vertices])
        return transform_points(blended, rest[vertices]) + parameters.transl[:, None]

    def _distance(self, points: Tensor, rows: slice) -> Tensor:
        """Signed distances of points to the masks' outlines, [T, P, 3] -> [T, P]."""
        views = self.views.rows(rows)
        return self.fields.sample(views.to_pixels(views.to_camera(points)), views.size, rows)

    def _outline(self, row: int, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices on a frame's outline and their weights, [P] both."""
        camera = self.cameras[row]
        scale = min(1.0, _DRAWN_SIDE / max(camera.width, camera.height))
        small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        drawn = rasterize(small, vertices, self.body.faces)
        edge = border(drawn.covered)
        corner = drawn.barycentrics[edge].argmax(-1)
        found = self.body.faces.numpy()[drawn.face[edge], corner]
        found = found[self.counted[row, self.part[found]]]
        kept = found[np.linspace(0, len(found) - 1, min(POINTS, len(found))).round().astype(int)]
        chosen, weight = np.zeros(POINTS, np.int64), np.zeros(POINTS, np.float32)
        chosen[: len(kept)], weight[: len(kept)] = kept, 1.0
        return torch.from_numpy(chosen), torch.from_numpy(weight)


def border(covered: np.ndarray) -> np.ndarray:
    """The pixels of a silhouette [H, W] bool that touch its outside, but for the picture's border."""
    inner = cv2.erode(covered.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    found = np.zeros_like(covered)
    middle = (slice(_MARGIN, -_MARGIN),) * 2
    found[middle] = (covered & ~inner)[middle]
    return found


def segments(body: BodyModel) -> Tensor:
    """A number for the joint that carries each vertex most, one for left and right: [V] int64."""
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
