"""The fitted body as a rigged, textured mesh for other programs: ``avatar.glb``."""

from pipeline.rig.rig_glb import write_rig_glb
from pipeline.rig.rigged_mesh import RiggedMesh, rigged_mesh
from pipeline.rig.surface_colors import SurfaceColors, avatar_colors

__all__ = ["RiggedMesh", "SurfaceColors", "avatar_colors", "rigged_mesh", "write_rig_glb"]
