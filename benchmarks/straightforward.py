"""The avatar as one would write it down from the paper: what the product's speed is measured against.

The same model and the same weights as ``pipeline.avatar.Avatar``, in plain torch: ``grid_sample`` on each
plane, the pose concatenated to every Gaussian's features, ``torch.nn.GroupNorm``, dense skinning weights,
float32, everything decoded again for every frame.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import roma
import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from pipeline.avatar import Avatar, Decoded, Posed, pose_features
from pipeline.avatar.canonical import HEAD
from pipeline.avatar.head import GroupNormReLU, Head
from pipeline.avatar.posed import LARGEST_SCALE, LOG_SCALE_RANGE
from pipeline.avatar.triplane import PLANES, Triplane, normalise
from pipeline.body import Pose, joint_transforms, linear_blend_skinning, vertex_normals
from pipeline.splat import Gaussians


class PlainTriplane(nn.Module):
    """Three feature planes a region, read with ``grid_sample``."""

    def __init__(self, theirs: Triplane, coordinates: Tensor, regions: Tensor):
        """Copies the planes.

        Args:
            theirs: the planes to copy.
            coordinates: [N, 3] in [-1, 1].
            regions: [N] int64.
        """
        super().__init__()
        self.planes = nn.Parameter(theirs.planes.detach().permute(0, 1, 4, 2, 3).contiguous())
        self.coordinates, self.regions = coordinates, regions

    def forward(self) -> Tensor:
        """The features of all points, [N, 3 * channels]."""
        features = self.planes.new_zeros(len(self.coordinates), 3 * self.planes.shape[2])
        for region, planes in enumerate(self.planes):
            inside = torch.nonzero(self.regions == region)[:, 0]
            points = self.coordinates[inside]
            where = torch.stack([points[:, list(plane)] for plane in PLANES])[:, None]  # [3, 1, n, 2]
            read = functional.grid_sample(planes, where, align_corners=True, padding_mode="border")
            features = features.index_copy(0, inside, read[:, :, 0].permute(2, 0, 1).flatten(1))
        return features


class PlainHead(nn.Module):
    """Four linear layers with GroupNorm and ReLU between, from one concatenated input."""

    def __init__(self, theirs: Head):
        """Copies the weights."""
        super().__init__()
        weights = theirs.state_dict()
        if theirs.condition is not None:
            joined = [weights["first.weight"], weights["condition.weight"]]
            weights["first.weight"] = torch.cat(joined, 1)
        self.layers = nn.Sequential()
        names = ["first", *(f"hidden.{place}" for place in range(len(theirs.hidden))), "last"]
        for place, name in enumerate(names):
            self.layers.append(_loaded(nn.Linear, weights, name))
            if name != "last":
                norm = _loaded(functools.partial(_norm, theirs), weights, f"norms.{place}")
                self.layers.extend([norm, nn.ReLU()])

    def forward(self, points: Tensor, shared: Tensor | None = None) -> Tensor:
        """Decodes [N, inputs], joined with the shared vector if there is one."""
        if shared is not None:
            points = torch.cat([points, shared.expand(len(points), -1)], 1)
        return self.layers(points)


class StraightforwardAvatar(nn.Module):
    """The finest level of an avatar, with weights of its own that start as copies."""

    def __init__(self, avatar: Avatar):
        """Copies the weights; the constants are shared."""
        super().__init__()
        self.surface, self.architecture = avatar.surfaces[-1], avatar.architecture
        self.base_color = avatar.base_color
        canonical = self.surface.canonical
        head = canonical.is_part(*HEAD).long()
        regions = head if len(avatar.boxes) == 2 else torch.zeros_like(head)
        coordinates = normalise(canonical.vertices, regions, avatar.boxes)
        networks = avatar.representation
        self.triplane = PlainTriplane(networks.triplane, coordinates, regions)
        self.geometry, self.color = PlainHead(networks.geometry), PlainHead(networks.color)
        self.pose_geometry = PlainHead(networks.pose_geometry)
        self.pose_color = PlainHead(networks.pose_color)

    def decode(self) -> Decoded:
        """As ``Avatar.decode``."""
        features = self.triplane()
        geometry, color = self.geometry(features), self.color(features)
        offset = geometry[:, :3] * self.architecture.offset_unit
        return Decoded(self.surface, features, offset, geometry[:, 3:], self.base_color + color)

    def pose(self, decoded: Decoded, pose: Pose) -> Posed:
        """As ``Avatar.pose``."""
        sizes, canonical = self.architecture, self.surface.canonical
        rotation, expression = pose.rotation, pose.expression
        transforms = joint_transforms(rotation[None], canonical.joints, canonical.parents)
        rest = canonical.vertices + canonical.expression_directions[..., : len(expression)] @ expression
        if canonical.pose_directions is not None:
            correctives = (roma.rotvec_to_rotmat(rotation[1:]) - torch.eye(3)).flatten()
            rest = rest + canonical.pose_directions @ correctives
        shape = rest + decoded.offset
        with torch.no_grad():
            posed = linear_blend_skinning(transforms, canonical.skinning_weights, shape)[0]
            normals = vertex_normals(posed, canonical.faces)
        theta = pose_features(rotation)
        geometry = self.pose_geometry(decoded.features, theta)
        color = self.pose_color(torch.cat([decoded.features, normals], 1), theta)
        pose_offset = geometry[:, :3] * sizes.pose_offset_unit * self.surface.pose_movable
        log_scale = decoded.log_scale + 0.5 * geometry[:, 3:]
        color_logit = decoded.color_logit + color
        gaussians = Gaussians(
            means=linear_blend_skinning(transforms, canonical.skinning_weights, shape + pose_offset)[0]
            + pose.transl,
            quaternions=self._quaternions(transforms[0]),
            scales=self._scales(log_scale),
            colors=torch.sigmoid(color_logit),
            opacities=torch.full((len(rest),), sizes.opacity),
        )
        return Posed(gaussians, pose_offset, log_scale, color_logit)

    def _scales(self, log_scale: Tensor) -> Tensor:
        across = self.surface.canonical.spacing * self.architecture.scale
        thick = across.mean(1, keepdim=True) * self.architecture.thickness
        initial = torch.cat([across, thick], 1)
        return (initial * torch.exp(log_scale.clamp(*LOG_SCALE_RANGE))).clamp(max=LARGEST_SCALE)

    def _quaternions(self, transforms: Tensor) -> Tensor:
        canonical = self.surface.canonical
        blended = (canonical.skinning_weights @ transforms.detach().flatten(1)).unflatten(1, (3, 4))
        turned = blended[..., :3] @ canonical.frames
        return roma.rotmat_to_unitquat(turned)[:, [3, 0, 1, 2]].contiguous()


def matched_gradients(avatar: Avatar, plain: StraightforwardAvatar) -> dict[str, tuple[Tensor, Tensor]]:
    """The gradients of both, parameter by parameter in the straightforward layout; for comparison.

    Returns:
        name -> (the avatar's, the straightforward one's), of equal shape.
    """
    planes, networks = avatar.representation.triplane.planes, avatar.representation
    assert planes.grad is not None and plain.triplane.planes.grad is not None
    pairs = {"planes": (planes.grad.permute(0, 1, 4, 2, 3), plain.triplane.planes.grad)}
    for name in ("geometry", "color", "pose_geometry", "pose_color"):
        ours, theirs = getattr(networks, name), getattr(plain, name)
        layers = [layer for layer in theirs.layers if not isinstance(layer, nn.ReLU)]
        assert ours.first.weight.grad is not None
        first = ours.first.weight.grad
        if ours.condition is not None:
            first = torch.cat([first, ours.condition.weight.grad], 1)
        pairs[f"{name}.first"] = (first, layers[0].weight.grad)
        for place, norm in enumerate(ours.norms):
            pairs[f"{name}.norm{place}.weight"] = (norm.weight.grad, layers[2 * place + 1].weight.grad)
            pairs[f"{name}.norm{place}.bias"] = (norm.bias.grad, layers[2 * place + 1].bias.grad)
        for place, layer in enumerate([*ours.hidden, ours.last]):
            pairs[f"{name}.layer{place + 1}"] = (layer.weight.grad, layers[2 * place + 2].weight.grad)
    return pairs


def _norm(head: Head, *_: int) -> nn.GroupNorm:
    norm = head.norms[0]
    assert isinstance(norm, GroupNormReLU)
    return nn.GroupNorm(norm.groups, len(norm.weight))


def _loaded(kind: Callable[..., nn.Module], weights: dict[str, Tensor], name: str) -> nn.Module:
    """A layer of that kind that holds the weights of that name."""
    weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
    layer = kind(*reversed(weight.shape))
    layer.load_state_dict({"weight": weight, "bias": bias})
    return layer
