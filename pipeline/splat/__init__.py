"""3D Gaussian splatting: Gaussians in, an image and its gradients out."""

from pipeline.splat.gaussians import Gaussians, Rendering
from pipeline.splat.ply import write_ply
from pipeline.splat.render import picture_sums, render

__all__ = ["Gaussians", "Rendering", "picture_sums", "render", "write_ply"]
