"""Running the auxiliary stage."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.body import load_landmarks
from pipeline.clip.fitted_clip import FittedClip
from pipeline.clip.plan import read_plan
from pipeline.errors import UserError
from pipeline.texture import fine_surface, gather_colors
from stages.auxiliary.crop import find_framing
from stages.auxiliary.filter_frames import filter_frames, take_all
from stages.auxiliary.folder import read_folder
from stages.auxiliary.generator_output import GeneratedPicture, GeneratorOutput
from stages.auxiliary.guidance import write_guidance
from stages.auxiliary.publish import publish
from stages.auxiliary.reference import make_reference
from stages.auxiliary.settings import AuxiliarySettings
from stages.auxiliary.skeleton import turntable_keypoints
from stages.auxiliary.texture_generator import complete, painted
from stages.auxiliary.turntable_motion import TurntableMotion, make_turntable_motion, read_numbered_clip

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
        return
    shutil.rmtree(context.work / "made", ignore_errors=True)
    clip = read_numbered_clip(context.inputs["ingest"], context.inputs["fit"], context.body_file)
    landmarks, settings = load_landmarks(clip.body, context.body), context.settings
    turn, surface = (
        make_turntable_motion(clip, settings),
        fine_surface(clip.body, settings.texture_levels),
    )
    frames = clip.spread(settings.texture_frames)
    with context.progress(len(frames), "texture") as progress:
        seen = gather_colors(surface, clip, frames, progress.advance)
    colors, framing = complete(surface, seen, settings.texture_light), find_framing(clip)
    context.log(f"the clip shows {seen.known.mean():.0%} of the surface")
    if generator != "texture" or settings.texture_guidance:
        reference = make_reference(clip, turn, landmarks, framing, surface, colors)
        keypoints = turntable_keypoints(clip, turn, landmarks)
        write_guidance(context, clip, turn, keypoints, reference)
    if generator == "guidance":
        return
    if generator == "texture":
        accepted = take_all(context, clip, landmarks, painted(clip, turn, surface, colors), len(turn.poses))
    else:
        output = generated(context, generator, clip, turn)
        if settings.check:
            accepted = filter_frames(context, clip, landmarks, output)
        else:
            accepted = take_all(context, clip, landmarks, output, len(output.poses))
    publish(context, clip, accepted, framing, surface, seen.known)


def chosen_generator(context: Context) -> str:
    """The setting, or what the plan calls for where it is ``auto``; off where there is no plan."""
    generator, plan = context.settings.generator, context.inputs.get("plan")
    called_for = plan is not None and read_plan(plan / "plan.json").on("auxiliary_views")
    if generator == "named":
        return named_generator(context.settings)
    if generator == "auto":
        generator = "texture" if called_for else "off"
    elif generator == "off" and called_for:
        context.log(
            "switched off, though the plan asks for views that no frame shows: auxiliary.generator=auto "
            "makes them"
        )
    if generator == "off" and not called_for:
        context.log("no auxiliary views are called for")
    return generator


def named_generator(settings: AuxiliarySettings) -> str:
    """``mimicmotion`` or ``folder``, whichever is named; never another in their place.

    Raises:
        UserError: neither is.
    """
    if settings.folder:
        return "folder"
    if settings.weights:
        return "mimicmotion"
    raise UserError(
        "generated views are asked for, and none can be made: name the folder of MimicMotion's weights as "
        "auxiliary.weights=FOLDER or frames made elsewhere as auxiliary.folder=FOLDER_OR_VIDEO, take "
        "auxiliary.generator=texture, or go without them: auxiliary.generator=off"
    )


def generated(context: Context, generator: str, clip: FittedClip, turn: TurntableMotion) -> GeneratorOutput:
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
    pictures = (
        GeneratedPicture(frame, image) for frame, image in zip(turn.poses.frames, images, strict=True)
    )
    return GeneratorOutput(turn.poses, cameras, pictures)
