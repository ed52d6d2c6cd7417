"""The operands of the losses: the static avatar, and one drawn frame beside its rendering."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import torch
from torch import Tensor

from pipeline.avatar import Decoded, Posed
from pipeline.avatar.identity_change import IdentityChange
from pipeline.avatar.sparse import SparsePair
from pipeline.clip.composite import composite, over
from pipeline.clip.views import View
from pipeline.metrics import Lpips
from pipeline.splat import Rendering
from stages.train import losses
from stages.train.body_regions import Regions, unmixed
from stages.train.face import Pasted, face_triangles, paste
from stages.train.poses import PoseRefinement
from stages.train.scene import BackgroundPlate
from stages.train.schedule import Draw


@dataclasses.dataclass(frozen=True, kw_only=True)
class StaticAvatar:
    """The part of the avatar that no pose changes, once a step.

    Attributes:
        decoded: the static heads' output.
        regions: of its mesh.
        identity: what is learnt of the identity; None where nothing is.
    """

    decoded: Decoded
    regions: Regions
    identity: IdentityChange | None = None

    @property
    def joint_change(self) -> Tensor | None:
        """The change of joint offsets, see ``IdentityChange.offset_change``; None where none is learnt."""
        return None if self.identity is None else self.identity.offset_change()

    @property
    def joint_asymmetry(self) -> Tensor | None:
        """See ``IdentityChange.asymmetry``; None where no identity is learnt."""
        return None if self.identity is None else self.identity.asymmetry()

    @property
    def neighbours(self) -> SparsePair:
        """The mean over each vertex's neighbours, [N, N]."""
        return self.decoded.surface.neighbours

    @property
    def normals(self) -> Tensor:
        """The canonical normals, [N, 3]."""
        return self.decoded.surface.canonical.frames[:, :, 2]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RenderedFrame(StaticAvatar):
    """One drawn frame and the avatar rendered in its pose.

    Attributes:
        draw: its random values.
        view: the frame.
        posed: the avatar in the frame's pose.
        rendering: of it.
        refinement: the poses that move; None where the frame is rendered in its fitted pose.
        texture: [N, 3], the mean colour at each Gaussian; None where no term asks for it.
        network: LPIPS; None where it has no weight.
        crop_side: of the square that LPIPS is taken of, pixels; 0 for the whole picture.
        scene: what is behind the person; None where it is not compared.
        scene_share: of L1 that is taken over the scene.
        metres: scales are compared with their neighbours in metres, not as logarithms.
    """

    draw: Draw
    view: View
    posed: Posed
    rendering: Rendering
    refinement: PoseRefinement | None
    texture: Tensor | None  # [N, 3]
    network: Lpips | None
    crop_side: int
    metres: bool
    scene: BackgroundPlate | None = None
    scene_share: float = 0.0

    @cached_property
    def target(self) -> Tensor:
        """The person over the drawn background, [H, W, 3]."""
        return self.view.composite(self.draw.background)

    @cached_property
    def image(self) -> Tensor:
        """The rendering over the drawn background, [H, W, 3]; the target where that is not to be trusted."""
        image = over(self.rendering.color, self.rendering.alpha, self.draw.background)
        if self.view.trust is None:
            return image
        return losses.blend_to_target(image, self.target, self.view.trust)

    @cached_property
    def over_scene(self) -> tuple[Tensor, Tensor] | None:
        """The rendering over the scene and the whole frame, [H, W, 3] each; None where there is no scene.

        Where neither the person nor the scene is known, they are equal. The frame is the photograph but for
        the mask's soft edge, where it is the person's own colours over the scene.
        """
        if self.scene is None or self.view.generated:
            return None
        color, alpha = self.view.color, self.view.alpha
        soft = ((alpha > 0) & (alpha < 1))[..., None]
        frame = torch.where(soft, composite(color, alpha, self.scene.color), color)
        image = over(self.rendering.color, self.rendering.alpha, self.scene.color)
        return losses.blend_to_target(image, frame, torch.maximum(self.scene.confidence, alpha)), frame

    @property
    def color_share(self) -> float:
        """The share of L1 that is taken over the drawn colour."""
        return 1.0 if self.over_scene is None else 1.0 - self.scene_share

    @property
    def pictures(self) -> tuple[Tensor, Tensor]:
        """The rendering and what it is compared with, over the scene where there is one."""
        return (self.image, self.target) if self.over_scene is None else self.over_scene

    @property
    def crops(self) -> tuple[Tensor, Tensor]:
        """A square of both pictures around a drawn place of the person, [side, side, 3] each."""
        place = losses.person_crop(self.view.alpha, self.crop_side, self.draw.place)
        image, target = self.pictures
        return image[place], target[place]

    @property
    def colors(self) -> Tensor:
        """The Gaussians' colours, [N, 3]."""
        return self.posed.gaussians.colors

    @property
    def compared_scale(self) -> Tensor:
        """The scales that are compared with their neighbours', [N, 3]: log scales, or metres."""
        return self.posed.gaussians.scales if self.metres else self.posed.log_scale

    @property
    def scale_change(self) -> Tensor | None:
        """Delta S_pose, [N, 3]: what the pose adds to the log scales; None while the pose heads are off."""
        if self.posed.pose_offset is None:
            return None
        return self.posed.log_scale - self.decoded.log_scale

    @cached_property
    def unmixed(self) -> Tensor | None:
        """The weight of smoothness terms, [N, 1]; None where the pose heads were asked for every Gaussian."""
        rows = self.posed.rows
        return None if rows is None else unmixed(rows, self.neighbours, len(self.colors))

    @property
    def offset(self) -> Tensor | None:
        """Static and pose-dependent offset together, [N, 3], metres; None while the pose heads are off."""
        change = self.posed.pose_offset
        return None if change is None else self.decoded.offset + change

    @property
    def underside_contrast(self) -> Tensor | None:
        """The arms' lower sides less the upper sides above them, [M, 3]; the upper sides get no gradient."""
        sides = self.regions.undersides
        return None if sides is None else self.colors[sides.rows] - sides.above @ self.colors.detach()

    @property
    def pose_change(self) -> Tensor | None:
        """The change of the frame's pose, [D], by ``PoseRefinement.change``; None where it does not move."""
        return None if self.refinement is None else self.refinement.change(self.draw.frame)

    @cached_property
    def face(self) -> Pasted:
        """The pixels that the face covers, in its mean texture.

        Raises:
            ValueError: there is no texture.
        """
        if self.texture is None:
            raise ValueError("the face term needs a texture")
        surface, means = self.decoded.surface, self.posed.gaussians.means
        canonical, texture = surface.canonical, surface.pick(self.texture)
        return paste(self.view.camera, means, canonical.faces, face_triangles(canonical), texture)
