"""The registration objective, Eq. 1: what each term weighs, and their sum.

Every term is summed over points and averaged over frames, so that weights do not depend on a clip's
length. Errors are measured in pixels of a picture whose long side is 512, so that they do not depend on
its size either.
"""

from __future__ import annotations

import dataclasses

import roma
import torch
from torch import Tensor

from pipeline.body import BodyModel, mean_identity, rest_joints
from pipeline.body.joints import BODY_POSE, JAW
from stages.fit import terms
from stages.fit.face_offset import mirror_matrix
from stages.fit.observations import Directions, Observations
from stages.fit.parameters import EYES, HANDS, LandmarkModel, Parameters
from stages.fit.ranges import joint_ranges
from stages.fit.settings import FitSettings
from stages.fit.views import Views

LONG_SIDE = 512.0
_CHEST_DISTANCE = 0.22  # metres; a hand seen before the torso is nearer than the shoulders by this
_SATURATION = (40.0, 20.0, 20.0, 20.0)  # pixels, by group: body, hands, face

# What holds each joint of body_pose to its initial rotation; the other joints have 0.3.
_STIFFNESS = {
    "spine1": 1.5, "spine2": 1.5, "spine3": 1.5, "neck": 1.5, "head": 1.5, "left_collar": 3.0,
    "right_collar": 3.0, "left_ankle": 1.0, "right_ankle": 1.0, "left_foot": 1.0, "right_foot": 1.0,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Prediction:
    """What parameters say about a clip.

    Attributes:
        rotation: [T, 55, 3], with the joints that nothing was seen of at their initial rotation.
        joints: [T, 55, 3], in the world.
        in_camera: [T, N, 3], landmarks in the camera's axes.
        pixels: [T, N, 2].
    """

    rotation: Tensor
    joints: Tensor
    in_camera: Tensor
    pixels: Tensor


class Objective:
    """The loss of a clip as a function of its parameters."""

    def __init__(
        self,
        body: BodyModel,
        observations: Observations,
        model: LandmarkModel,
        views: Views,
        initial: Parameters,
        movable: Tensor,  # [55]
        settings: FitSettings,
    ) -> None:
        """Prepare what does not change during the optimisation."""
        self.observations, self.model, self.views = observations, model, views
        self.settings, self.initial = settings, initial
        self.initial_rotation = initial.rotation
        self.movable = movable[:, None]
        self.weight = observations.mask * observations.weight
        self.saturation = torch.tensor(_SATURATION)[observations.group]
        self.scale = (LONG_SIDE / views.size.amax(1))[:, None, None]
        self.times = (observations.frames - observations.frames[0]).float()
        names = [body.joint_names[j] for j in range(BODY_POSE.start, BODY_POSE.stop)]
        self.ranges = joint_ranges()
        self.stiffness = torch.tensor([_STIFFNESS.get(name, 0.3) for name in names])
        kinds = (observations.limbs, observations.hand_bones)
        self.bones = [(bones, *_picks(bones, len(observations.group))) for bones in kinds]
        self.shoulders = list(observations.shoulders)
        self.face = observations.of("face") & (model.face.sum(1) > 0)
        self.mirror_face = mirror_matrix(model.rest[self.face])
        self.mirror_joints = mirror_matrix(rest_joints(body, mean_identity(body)))

    def predict(self, parameters: Parameters) -> Prediction:
        """Pose and project the landmarks."""
        rotation = torch.where(self.movable, parameters.rotation, self.initial_rotation)
        points, joints = self.model.posed(parameters, rotation)
        in_camera = self.views.to_camera(points)
        return Prediction(rotation, joints, in_camera, self.views.to_pixels(in_camera))

    def __call__(self, parameters: Parameters, robust: bool) -> dict[str, Tensor]:
        """The weighted terms of Eq. 1, each a number; their sum is the loss.

        Args:
            parameters: the unknowns.
            robust: let the error of a point saturate; at the start every point pulls in proportion.
        """
        predicted = self.predict(parameters)
        return {
            "keypoints": self._keypoints(predicted, robust),
            "directions": self._directions(predicted),
            "in_front": self._in_front(predicted),
            "init": self.settings.lambda_init * self._init(parameters, predicted.rotation),
            "sreg": self.settings.lambda_sreg * self._sreg(parameters),
            "smooth": self.settings.smoothness * self._smooth(parameters, predicted),
        }

    def residuals(self, parameters: Parameters) -> Tensor:
        """Reprojection errors, [T, N], pixels of the stored frames; NaN where masked."""
        with torch.no_grad():
            error = (self.predict(parameters).pixels - self.observations.pixels).norm(dim=-1)
        return torch.where(self.observations.mask, error, torch.full_like(error, torch.nan))

    def _keypoints(self, predicted: Prediction, robust: bool) -> Tensor:
        pixels, target = predicted.pixels * self.scale, self.observations.pixels * self.scale
        saturation = self.saturation if robust else None
        error = terms.keypoint_loss(pixels, target, self.observations.mask, saturation)
        return (error * self.weight).sum(1).mean() / 8

    def _directions(self, predicted: Prediction) -> Tensor:
        total = predicted.pixels.new_zeros(())
        for bones, start, end in self.bones:
            loss = terms.direction_loss(start @ predicted.in_camera, end @ predicted.in_camera, bones.unit)
            total = total + (loss * bones.weight).sum(1).mean()
        return total

    def _in_front(self, predicted: Prediction) -> Tensor:
        """Hands seen before a chest that faces the camera are in front of it."""
        shoulders = predicted.pixels[:, self.shoulders].detach()
        left, right = shoulders[:, :1, 0], shoulders[:, 1:, 0]
        pixels, margin = predicted.pixels.detach(), 5 / self.scale[..., 0]
        over = (pixels[..., 0] > right - margin) & (pixels[..., 0] < left + margin)
        over = over & (pixels[..., 1] > shoulders[..., 1].mean(1, keepdim=True))
        over = over & self.observations.mask & self.observations.hands
        depth = predicted.in_camera[..., 2]
        chest = (depth[:, self.shoulders[0]] + depth[:, self.shoulders[1]]) / 2
        return 20 * (terms.in_front_loss(depth, chest, _CHEST_DISTANCE) * over).sum(1).mean()

    def _init(self, parameters: Parameters, rotation: Tensor) -> Tensor:
        """L_init and the priors on single joints."""
        start = self.initial_rotation
        pose = terms.initial_loss(rotation[:, BODY_POSE], start[:, BODY_POSE]).sum(-1) * self.stiffness
        hands = terms.initial_loss(rotation[:, HANDS], start[:, HANDS])
        expression = terms.initial_loss(parameters.expression, self.initial.expression)
        eyes, jaw = rotation[:, EYES].square(), rotation[:, JAW].square()
        ranges = self.ranges
        outside = terms.range_loss(ranges.of(rotation), ranges.low, ranges.high)
        return (
            0.4 * pose.sum(1).mean()
            + 0.045 * hands.sum((1, 2)).mean()
            + 0.05 * expression.sum(1).mean()
            + 20 * jaw[:, 1:].sum(1).mean()
            + 0.5 * eyes.sum((1, 2)).mean()
            + 20 * eyes[..., 2].sum(1).mean()
            + 5 * outside.sum(1).mean()
        )

    def _sreg(self, parameters: Parameters) -> Tensor:
        """L_sreg, Eq. 5, and the length of the face offsets."""
        face_offset = self.model.face[self.face] @ parameters.face_control
        return (
            0.1 * terms.shape_loss(parameters.betas).sum()
            + 500 * terms.joint_offset_loss(parameters.joint_offset).sum()
            + 500 * terms.symmetry_loss(parameters.joint_offset, self.mirror_joints).sum()
            + 2000 * terms.face_offset_loss(face_offset).sum()
            + 500 * terms.symmetry_loss(face_offset, self.mirror_face).sum()
        )

    def _smooth(self, parameters: Parameters, predicted: Prediction) -> Tensor:
        """Accelerations of joints and place, and a little velocity of everything."""
        count = len(self.times)
        placed = terms.acceleration(predicted.joints - parameters.transl[:, None], self.times).square()
        moved = terms.acceleration(parameters.transl, self.times).square()
        total = 200 * (placed.sum() + moved.sum()) / count
        matrices = roma.rotvec_to_rotmat(predicted.rotation)
        turned = terms.velocity(matrices, self.times).square().sum((2, 3)) / 2  # about the squared angle
        joints = turned.new_full((55,), 1.0)
        joints[0], joints[BODY_POSE], joints[JAW], joints[EYES] = 10.0, 3.0, 2.0, 0.5
        changed = terms.velocity(parameters.expression, self.times).square()
        return total + ((turned * joints).sum() + 0.05 * changed.sum()) / count


def _picks(bones: Directions, count: int) -> tuple[Tensor, Tensor]:
    """Matrices [L, N] that pick the bones' starts and ends."""
    one_hot = torch.nn.functional.one_hot
    return one_hot(bones.start, count).float(), one_hot(bones.end, count).float()
