"""Running the auxiliary stage."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.body import load_landmarks, posed_vertices
from pipeline.clip.fitted_clip import FittedClip
from pipeline.clip.plan import read_plan
from pipeline.errors import UserError
from stages.auxiliary import texture
from stages.auxiliary.accept import accept_checked, accept_exact
from stages.auxiliary.crop import find_framing
from stages.auxiliary.folder import read_folder
from stages.auxiliary.guidance import write_guidance
from stages.auxiliary.offer import Offer, Picture
from stages.auxiliary.publish import publish
from stages.auxiliary.reference import make_reference
from stages.auxiliary.skeleton import turn_keypoints
from stages.auxiliary.turn import Turn, make_turn, read_numbered_clip

if TYPE_CHECKING:
    from pipeline.run.stage import Context


def run(context: Context) -> None:
    """Makes views that the camera never saw, if the scene calls for them.

    Publishes ``guidance/`` (``guidance.py``), and of the frames that are fit to learn from ``frames/``,
    ``masks/``, ``trust/``, ``cameras.parquet``, ``poses.parquet``, ``keypoints.parquet`` and
    ``auxiliary.json``. Publishes nothing at all where no auxiliary views are called for.

    Raises:
        UserError: the inputs or the generator's frames cannot be used.
    """
    generator = chosen_generator(context)
    if generator == "off":
        context.log("no auxiliary views are called for")
        return
    shutil.rmtree(context.work / "made", ignore_errors=True)
    clip = read_numbered_clip(context.inputs["ingest"], context.inputs["fit"], context.body_file)
    landmarks, settings = load_landmarks(clip.body, context.body), context.settings
    turn, surface = make_turn(clip, settings), texture.fine_surface(clip.body, settings.texture_levels)
    frames = clip.spread(settings.texture_frames)
    with context.progress(len(frames), "texture") as progress:
        seen = texture.gather_colors(surface, clip, frames, progress.advance)
    colors, framing = texture.complete(surface, seen, settings.texture_light), find_framing(clip)
    context.log(f"the clip shows {seen.known.mean():.0%} of the surface")
    if generator != "texture" or settings.texture_guidance:
        reference = make_reference(clip, turn, landmarks, framing, surface, colors)
        keypoints = turn_keypoints(clip, turn, landmarks)
        write_guidance(context, clip, turn, keypoints, reference)
    if generator == "guidance":
        return
    if generator == "texture":
        accepted = accept_exact(
            context, clip, landmarks, painted(clip, turn, surface, colors), len(turn.poses)
        )
    else:
        offer = offered(context, generator, clip, turn)
        if settings.check:
            accepted = accept_checked(context, clip, landmarks, offer)
        else:
            accepted = accept_exact(context, clip, landmarks, offer, len(offer.poses))
    publish(context, clip, accepted, framing, surface, seen.known)


def chosen_generator(context: Context) -> str:
    """The setting, or what the plan calls for where it is ``auto``; off where there is no plan."""
    generator, plan = context.settings.generator, context.inputs.get("plan")
    called_for = plan is not None and read_plan(plan / "plan.json").on("auxiliary_views")
    if generator == "off" and called_for:
        context.log("the plan asks for views that no frame shows: auxiliary.generator=auto makes them")
    if generator != "auto":
        return generator
    return "texture" if called_for else "off"


def painted(clip: FittedClip, turn: Turn, surface: texture.FineSurface, colors: np.ndarray) -> Offer:
    """The ``texture`` generator: the textured body through the turn."""

    def pictures() -> Iterator[Picture]:
        for frame in turn.poses.frames:
            vertices = posed_vertices(clip.body, clip.identity, turn.poses.pose(frame))
            image, mask, _ = texture.paint(turn.camera, surface, vertices, colors)
            yield Picture(frame, image, mask)

    return Offer(turn.poses, dict.fromkeys(turn.poses.frames, turn.camera), pictures(), exact=True)


def offered(context: Context, generator: str, clip: FittedClip, turn: Turn) -> Offer:
    """The frames of ``folder`` or ``mimicmotion``."""
    settings = context.settings
    if generator == "folder":
        return read_folder(Path(settings.folder), clip, turn, context.body_file)
    try:
        from stages.auxiliary.mimicmotion import animate
    except ImportError as error:
        raise UserError(
            f"auxiliary.generator=mimicmotion needs diffusers ({error}): pip install -e '.[diffusion]'"
        ) from None
    images = animate(context, context.output / "guidance")
    cameras = dict.fromkeys(turn.poses.frames, turn.camera)
    pictures = (Picture(frame, image) for frame, image in zip(turn.poses.frames, images, strict=True))
    return Offer(turn.poses, cameras, pictures)
