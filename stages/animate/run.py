"""Running the animate stage: a motion is read, given to the avatar, and drawn_frames."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Iterator
from typing import Any, get_args

import numpy as np
import torch

from pipeline.avatar import Avatar, load_avatar
from pipeline.body import JOINT_NAMES, BodyModel, load_body, read_poses, rest_joints, write_poses
from pipeline.clip.camera import Camera
from pipeline.clip.composite import over, to_bytes
from pipeline.clip.frames import spread_end_to_end, write_png, write_video
from pipeline.clip.records import read_cameras, read_split, write_cameras
from pipeline.config.choices import SplatFormat
from pipeline.files.json_files import write_json
from pipeline.pictures import PAPER, contact_sheet, shrunk
from pipeline.pose_files import read_hand_mean
from pipeline.run.stage import Context
from pipeline.splat import Gaussians, Rendering, render
from pipeline.splat.splat_files import write_splats
from stages.animate.actor import Actor, PoseRange, legs_share, make_actor
from stages.animate.cameras import Animation, cameras_of, clip_start, turntable
from stages.animate.exr_layers import NAMES, exr_layers, write_layers
from stages.animate.idle_settings import idle_settings
from stages.animate.motions.motion import Span
from stages.animate.motions.placement import place
from stages.animate.motions.read import DrivenPerson, read_motion, with_relaxed_hands
from stages.animate.motions.source import TURNTABLE, motion_source
from stages.animate.settings import AnimateSettings

SPLATS = get_args(SplatFormat)
_HALF_LEGS = 0.5  # share of the legs' Gaussians from which on an avatar can walk
_WORTH_BAKING = 24  # poses; baking 54,000 Gaussians takes as long as it saves in about so many
_SHOWN = 12  # joints named in a line
_SHEET_COLUMNS, _SHEET_SIDE = 4, 320  # of frames.png; pixels of a picture's longer side


def run(context: Context) -> None:
    """Animates one subject.

    Publishes ``frames.png``, ``cameras.parquet``, ``motion.parquet`` (the poses) and ``animate.json``, and
    what is asked for of ``animation.mp4``, ``exr/<frame>.exr`` (see ``layers``) and splats,
    ``ply/<frame>.ply``, ``spz/`` and ``glb/``, frames numbered from 0.

    Raises:
        UserError: the motion cannot be read, or a file of an upstream stage is missing or damaged.
    """
    settings: AnimateSettings = context.settings
    body = load_body(context.body_file)
    avatar = load_avatar(context.inputs["train"] / "avatar.safetensors", body)
    legs = legs_share(avatar, body)
    gated = not bool(avatar.active.all())
    idle = idle_settings(settings, motion_source(settings.motion).kind, gated)
    for sentence in idle:
        context.log(sentence)
    animation = make_animation(context, avatar, body, legs)
    start = time.monotonic()
    actor = ready_actor(context, avatar, animation)
    context.timing("decode_seconds", time.monotonic() - start)
    cameras = frame_cameras(context, animation, actor, body)
    draw_animation(context, animation, actor, cameras)
    write_cameras(context.output / "cameras.parquet", dict(enumerate(cameras)))
    write_poses(context.output / "motion.parquet", animation.poses)
    write_json(context.output / "animate.json", summary(settings, animation, actor, legs, idle))
    log_result(context, animation, len(actor))


def make_animation(context: Context, avatar: Avatar, body: BodyModel, legs: float) -> Animation:
    """Reads the motion and gives it to the person."""
    settings: AnimateSettings = context.settings
    name, identity = motion_source(settings.motion), avatar.identity
    if name.kind == TURNTABLE:
        return turntable(body, identity, settings)
    span = Span(settings.first_frame, settings.last_frame, settings.fps)
    person = DrivenPerson(body, context.body_file, identity)
    motion = read_motion(name, person, span, settings.up, context.loans)
    motion = with_relaxed_hands(motion, read_hand_mean(context.body_file))
    placed = place(motion, body, identity, in_place(settings, legs))
    return Animation(placed, motion.numbers, motion.fps, motion=motion)


def in_place(settings: AnimateSettings, legs: float) -> bool:
    """True if the pelvis stays where it is."""
    return settings.way == "still" or (settings.way == "auto" and legs < _HALF_LEGS)


def ready_actor(context: Context, avatar: Avatar, animation: Animation) -> Actor:
    """The avatar, ready to be moved."""
    settings: AnimateSettings = context.settings
    poses = 1 if animation.still else len(animation)
    baking = settings.bake == "on" or (settings.bake == "auto" and poses >= _WORTH_BAKING)
    known = None
    if settings.heads == "known":
        train = read_split(context.inputs["ingest"] / "split.json").train
        known = PoseRange.of(read_poses(context.inputs["fit"] / "poses.parquet"), train)
    return make_actor(avatar, baking, settings.unseen, known)


def frame_cameras(context: Context, animation: Animation, actor: Actor, body: BodyModel) -> list[Camera]:
    """A camera a frame."""
    ingest, identity = context.inputs["ingest"], actor.avatar.identity
    poses = read_poses(context.inputs["fit"] / "poses.parquet")
    origin = clip_start(poses, read_cameras(ingest / "cameras.parquet"), body, identity)
    pelvis = rest_joints(body, identity)[0] + animation.placed.transl[0]
    return cameras_of(
        animation,
        lambda frame: actor.gaussians(animation.placed.pose(frame)),
        context.settings,
        origin,
        pelvis,
    )


def draw_animation(context: Context, animation: Animation, actor: Actor, cameras: list[Camera]) -> None:
    """Draws every frame once and writes what is asked for."""
    settings: AnimateSettings = context.settings
    for kind in ("exr", *SPLATS):
        if kind in settings.outputs:
            (context.output / kind).mkdir()
    wanted = settings.sheet_frames
    on_sheet = {0} if wanted == 1 else set(spread_end_to_end(range(len(animation)), wanted))
    kept: dict[str, np.ndarray] = {}
    spent: dict[str, list[float]] = defaultdict(list)
    with context.progress(len(animation), "drawing") as progress:

        def pictures() -> Iterator[np.ndarray]:
            for frame, picture in drawn_frames(context, animation, actor, cameras, spent):
                if frame in on_sheet:
                    kept[f"{animation.numbers[frame]}  {frame / animation.fps:.2f} s"] = picture
                yield picture
                progress.advance()

        if "video" in settings.outputs:
            write_video(context.output / "animation.mp4", pictures(), animation.fps)
        else:
            for _ in pictures():
                pass
    small = [shrunk(picture, _SHEET_SIDE) for picture in kept.values()]
    columns = min(_SHEET_COLUMNS, len(small))
    write_png(context.output / "frames.png", contact_sheet(small, columns, list(kept), PAPER, gap=4))
    each = {name: round(1e3 * statistics.median(times), 3) for name, times in spent.items()}
    context.timing("milliseconds_a_frame", each)


def drawn_frames(
    context: Context, animation: Animation, actor: Actor, cameras: list[Camera], spent: dict[str, list[float]]
) -> Iterator[tuple[int, np.ndarray]]:
    """Every frame with its picture; splats and layers are make_animation on the way, if they are asked for.

    Args:
        spent: filled with the seconds that each frame took, by what.
    """
    settings: AnimateSettings = context.settings
    gaussians: Gaussians | None = None
    for frame, camera in enumerate(cameras):
        timer = _Timer(spent)
        fresh = gaussians is None or not animation.still
        if gaussians is None or fresh:
            gaussians = actor.gaussians(animation.placed.pose(frame))
        timer.note("pose")
        with torch.no_grad():
            rendering = render(gaussians, camera)
        timer.note("render")
        for kind in SPLATS:
            if kind in settings.outputs and fresh:
                file = context.output / kind / f"{frame:06d}.{kind}"
                write_splats(file, gaussians, settings.ply_up, context.subject)
                timer.note(kind)
        if "exr" in settings.outputs:
            layers = exr_layers(gaussians, actor.parts, camera, rendering)
            timer.note("layers")
            write_layers(context.output / "exr" / f"{frame:06d}.exr", layers)
            timer.note("exr")
        yield frame, on_background(rendering, settings.color)


def on_background(rendering: Rendering, color: tuple[float, float, float]) -> np.ndarray:
    """The video's picture, mixed as the clip's colours are encoded: [H, W, 3] uint8 RGB."""
    return to_bytes(over(rendering.color, rendering.alpha, torch.tensor(color)))


class _Timer:
    """Seconds since the last look, by what they were spent on."""

    def __init__(self, spent: dict[str, list[float]]) -> None:
        self.spent, self.last = spent, time.perf_counter()

    def note(self, name: str) -> None:
        now = time.perf_counter()
        self.spent[name].append(now - self.last)
        self.last = now


def summary(
    settings: AnimateSettings, animation: Animation, actor: Actor, legs: float, idle: tuple[str, ...]
) -> dict[str, Any]:
    """The content of ``animate.json``. Times, which differ between equal runs, are in ``run.json``."""
    motion = animation.motion
    found: dict[str, Any] = {
        "motion": motion.name if motion else TURNTABLE,
        "frames": len(animation),
        "fps": animation.fps,
        "source_frames": list(animation.numbers),
        "gaussians": len(actor),
        "baked": actor.baked is not None,
        "background": settings.background,
        "unseen": "base" if actor.extra is not None else "nothing",
        "heads": settings.heads,
        "without_effect": list(idle),
    }
    if motion is not None:
        still = in_place(settings, legs)
        found |= {
            "scale": round(animation.placed.scale, 6),
            "way": {"kept": not still, "share_of_legs": round(legs, 4), "threshold": _HALF_LEGS},
            "joints_not_told": [name for name in JOINT_NAMES if name not in motion.told],
            "joints_not_used": list(motion.unused),
            "notes": list(motion.notes),
        }
    if "exr" in settings.outputs:
        found["layers"] = list(NAMES)
    return found


def log_result(context: Context, animation: Animation, gaussians: int) -> None:
    """Says in a few lines what was made and what a user should know of it."""
    motion = animation.motion
    for note in motion.notes if motion else ():
        context.log(note)
    if motion and motion.unused:
        more = f" and {len(motion.unused) - _SHOWN} more" if len(motion.unused) > _SHOWN else ""
        context.log(
            f"joints of {motion.name} without a counterpart: {', '.join(motion.unused[:_SHOWN])}{more}"
        )
    times = ", ".join(
        f"{name} {value:.1f}" for name, value in context.timings.get("milliseconds_a_frame", {}).items()
    )
    context.log(
        f"{len(animation)} frames at {animation.fps:.4g} a second, {gaussians} Gaussians; ms a frame: {times}"
    )
