"""The networks, and reading them from a folder.

The folder has diffusers' layout of Stable Video Diffusion (``unet/``, ``vae/``, ``image_encoder/``,
``scheduler/``, weights as safetensors) and ``mimicmotion.safetensors``, whose entries ``unet.*`` replace the
UNet's and ``pose_net.*`` are the PoseNet's. docs/auxiliary.md says how the published file becomes one.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from pipeline.errors import UserError

WEIGHTS = "mimicmotion.safetensors"
PARTS = ("unet", "vae", "image_encoder", "scheduler")
_REMEDY = "docs/auxiliary.md says what auxiliary.weights must hold"
_CLIP_MEAN, _CLIP_DEVIATION = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
_CLIP_SIDE = 224
_WIDTHS = ((3, 1), (16, 2), (16, 1), (32, 2), (32, 1), (64, 2), (64, 1), (128, 1))
"""Channels and stride of the eight convolutions; together they divide the picture's sides by 8."""


class PoseNet(nn.Module):
    """Eight convolutions with SiLU, then one of a pixel that starts at zero, times a learnt number.

    At the start of its training nothing is added, so that the video model is what it was.
    """

    def __init__(self, channels: int = 320):
        """Args: channels of the UNet's first features."""
        super().__init__()
        layers: list[nn.Module] = []
        before = 3
        for width, stride in _WIDTHS:
            kernel = 4 if stride == 2 else 3
            layers += [nn.Conv2d(before, width, kernel, stride, padding=1), nn.SiLU()]
            before = width
        self.conv_layers = nn.Sequential(*layers)
        self.final_proj = nn.Conv2d(before, channels, 1)
        nn.init.zeros_(self.final_proj.weight)
        nn.init.zeros_(self.final_proj.bias)  # type: ignore[arg-type]
        self.scale = nn.Parameter(torch.full((1,), 2.0))

    def forward(self, poses: Tensor) -> Tensor:
        """Skeletons [F, 3, H, W] in [-1, 1] -> [F, channels, H / 8, W / 8]."""
        return self.final_proj(self.conv_layers(poses)) * self.scale


@dataclasses.dataclass(frozen=True)
class Model:
    """The parts of a pose-driven video model.

    Attributes:
        unet: ``UNetSpatioTemporalConditionModel``.
        pose_net: what turns skeletons into features.
        vae: ``AutoencoderKLTemporalDecoder``.
        image_encoder: ``CLIPVisionModelWithProjection``.
        scheduler: ``EulerDiscreteScheduler``.
    """

    unet: Any
    pose_net: PoseNet
    vae: Any
    image_encoder: Any
    scheduler: Any

    @property
    def device(self) -> torch.device:
        return self.pose_net.scale.device

    def predict(
        self, sample: Tensor, timestep: Tensor, embedding: Tensor, times: Tensor, poses: Tensor | None
    ) -> Tensor:
        """The UNet's answer with the PoseNet's features added after its first convolution.

        Args:
            sample: [1, F, 8, h, w], noisy latents and the reference's.
            timestep: scalar.
            embedding: [1, 1, C], of the reference picture.
            times: [1, 3], frame rate, motion and noise.
            poses: [F, channels, h, w], or None to add nothing.

        Returns:
            [1, F, 4, h, w].
        """
        hook = None
        if poses is not None:
            hook = self.unet.conv_in.register_forward_hook(lambda module, given, answer: answer + poses)
        try:
            return self.unet(
                sample, timestep, encoder_hidden_states=embedding, added_time_ids=times, return_dict=False
            )[0]
        finally:
            if hook is not None:
                hook.remove()

    def describe(self, image: Tensor) -> Tensor:
        """CLIP's embedding of a picture: [3, H, W] in [-1, 1] -> [1, 1, C]."""
        small = torch.nn.functional.interpolate(
            image[None], (_CLIP_SIDE, _CLIP_SIDE), mode="bicubic", antialias=True, align_corners=False
        )
        mean, deviation = (small.new_tensor(v).view(1, 3, 1, 1) for v in (_CLIP_MEAN, _CLIP_DEVIATION))
        pixels = ((small + 1) / 2 - mean) / deviation
        return self.image_encoder(pixels.to(self.image_encoder.dtype)).image_embeds[:, None]

    def encode(self, image: Tensor) -> Tensor:
        """The reference's latents: [3, H, W] in [-1, 1] -> [4, h, w]."""
        return self.vae.encode(image[None].to(self.vae.dtype)).latent_dist.mode()[0]

    def decode(self, latents: Tensor) -> Tensor:
        """Pictures of latents: [F, 4, h, w] -> [F, 3, H, W] float32 in [0, 1]."""
        scaled = latents.to(self.vae.dtype) / self.vae.config.scaling_factor
        pictures = self.vae.decode(scaled, num_frames=len(latents)).sample
        return (pictures.float() / 2 + 0.5).clamp(0, 1)


def load_model(folder: Path, device: torch.device, dtype: torch.dtype) -> Model:
    """Read the networks; nothing is downloaded and nothing unpickled.

    Raises:
        UserError: a part is missing, damaged, or its entries are not the network's.
    """
    from diffusers import (
        AutoencoderKLTemporalDecoder,
        EulerDiscreteScheduler,
        UNetSpatioTemporalConditionModel,
    )
    from transformers import CLIPVisionModelWithProjection

    for part in PARTS:
        if not (folder / part).is_dir():
            raise UserError(f"{folder / part} is missing: {_REMEDY}")
    if not (folder / WEIGHTS).is_file():
        raise UserError(f"{folder / WEIGHTS} is missing: {_REMEDY}")
    options = {"local_files_only": True, "use_safetensors": True, "torch_dtype": dtype}
    try:
        unet = UNetSpatioTemporalConditionModel.from_pretrained(folder / "unet", **options)
        vae = AutoencoderKLTemporalDecoder.from_pretrained(folder / "vae", **options)
        encoder = CLIPVisionModelWithProjection.from_pretrained(
            folder / "image_encoder", local_files_only=True, use_safetensors=True, dtype=dtype
        )
        scheduler = EulerDiscreteScheduler.from_pretrained(folder / "scheduler", local_files_only=True)
        entries = load_file(folder / WEIGHTS)
        pose_net = PoseNet(unet.config.block_out_channels[0]).to(dtype)
        pose_net.load_state_dict(_under(entries, "pose_net."))
        replaced = _under(entries, "unet.")
        if replaced:
            unet.load_state_dict(replaced)
    except (OSError, ValueError, RuntimeError, KeyError, SafetensorError) as error:
        raise UserError(f"{folder} cannot be read as MimicMotion ({error}): {_REMEDY}") from error
    networks: tuple[Any, ...] = (unet, pose_net, vae, encoder)
    unet, pose_net, vae, encoder = (network.to(device).eval().requires_grad_(False) for network in networks)
    return Model(unet, pose_net, vae, encoder, scheduler)


def _under(entries: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): entry for name, entry in entries.items() if name.startswith(prefix)}
