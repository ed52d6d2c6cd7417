"""3D Gaussian splatting: Gaussians in, an image and its gradients out."""

from pipeline.splat.gaussians import Gaussians, Rendering
from pipeline.splat.ply import read_ply, write_ply
from pipeline.splat.render import render

__all__ = ["Gaussians", "Rendering", "read_ply", "render", "write_ply"]
