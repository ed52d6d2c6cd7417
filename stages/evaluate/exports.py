"""The avatar as files for other programs: splats in a relaxed pose, and the body as a rigged mesh."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path

from pipeline.avatar import Avatar
from pipeline.body import BodyModel, Pose
from pipeline.body.expressions import read_expressions
from pipeline.rig import RiggedMesh, SurfaceColors, avatar_colors, rigged_mesh, write_rig_glb
from pipeline.rig.surface_colors import shown_vertices
from pipeline.run.stage import Context
from pipeline.splat import Gaussians
from pipeline.splat.splat_files import write_splats
from stages.evaluate.settings import EvaluateSettings

RIG = "avatar.glb"
SPLATS = ("avatar.ply", "avatar.spz", "avatar_splats.glb")


@dataclasses.dataclass(frozen=True)
class Rig:
    """The body's mesh and the avatar's colours on it."""

    mesh: RiggedMesh
    colors: SurfaceColors


def avatar_rig(avatar: Avatar, body: BodyModel, body_file: Path, pose: Pose) -> Rig:
    """The rig of a finished avatar: what it shows of the body, in its colours.

    Args:
        avatar: finished.
        body: its body.
        body_file: the body's file, for the expressions' names.
        pose: the one whose colours are taken.

    Raises:
        UserError: the body's file cannot be read.
    """
    expressions = read_expressions(body_file, body.expression_directions.shape[2])
    shown = shown_vertices(avatar, len(body.v_template))
    return Rig(rigged_mesh(body, avatar.identity, expressions, shown), avatar_colors(avatar, pose))


def write_exports(context: Context, relaxed: Gaussians, rig: Rig | None) -> Mapping[str, int]:
    """Writes the files; returns name -> bytes. The seconds of each go to ``run.json``.

    Args:
        context: of the run.
        relaxed: the splats, in a relaxed pose.
        rig: the rig, where the avatar has a body.
    """
    settings: EvaluateSettings = context.settings
    seconds = {}
    for name in SPLATS:
        start = time.monotonic()
        write_splats(context.output / name, relaxed, settings.ply_up, context.subject)
        seconds[name] = round(time.monotonic() - start, 3)
    if rig is not None:
        start = time.monotonic()
        write_rig_glb(context.output / RIG, rig.mesh, rig.colors, context.subject, settings.glb_texture)
        seconds[RIG] = round(time.monotonic() - start, 3)
    context.timing("export_seconds", seconds)
    return {name: (context.output / name).stat().st_size for name in sorted(seconds)}
