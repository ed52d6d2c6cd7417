"""Decisions from measured numbers. Thresholds were chosen on mannequins, whose content is known."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from pipeline.avatar.otsu_threshold import LEAST_CUT, evidence_threshold
from pipeline.body import PARTS, rest_joints
from pipeline.clip.plan import COUNTED, EFFECTS, GATHERED, SEEN_PARTS, Decision, Plan
from stages.plan.measure import (
    PlanInputs,
    gaussian_pixels,
    gaussians_by_part,
    mean_error,
    part_pixels,
    pose_change,
    unseen_azimuths,
    visibility,
)
from stages.plan.settings import PlanSettings

# As in stages/ingest/cameras/background_motion.py, which is where it decides; a test compares them.
BACKGROUND_MOTION = 0.03

# Share of a part's vertices. Mannequins: what a framing shows reaches 0.4 and more, what it does not 0.
PART_SEEN = 0.1

# Pixels across. Hands of the full mannequin (21 to 23) and its face (24) hold fewer pixels than Gaussians
# stand there: nothing finer is left to add. The upper mannequin's hand has 76, its face 72.
RESIDUAL_PIXELS = 32.0

# Pixels from one Gaussian to the next. Whole bodies at 256 to 512 pixels have 1.1: four times as many
# cost 2.3 to 3.2 times the training and 0.15 dB; an upper body of 2.5 gains a seventh of its LPIPS by them
# and a head of 3.8 a third (docs/log/2026-11.md).
GAUSSIAN_PIXELS = 1.5

# Steps of a clip of so many frames; those of others grow with the root of their number, within limits.
STEPS, STEPS_FRAMES = 500, 65
LEAST_STEPS, MOST_STEPS = 0.8, 2.0

# Of the person's size. Mannequins that stand still, head and upper body: 0.031 and 0.028, which is what the
# detector's errors leave; those that move: 0.138 and more.
POSE_CHANGE = 0.045

# Degrees of the widest unseen range. Skin turned away by up to 60 degrees is still seen well, so that a
# range of 120 is covered from its two sides.
UNSEEN_RANGE = 120.0

FIT_PIXELS = 0.25  # under a quarter of a pixel there is nothing left to refine
# Mean error over the person's size, the side of a square of the mask's area: beyond, held-out scores judge
# the fit rather than the avatar. Before, 4 pixels stood here, which is this for a head that fills 512.
HELD_OUT_ERROR = 0.02


def decide(inputs: PlanInputs, settings: PlanSettings) -> Plan:
    """The plan of a clip."""
    scores, seen = visibility(inputs)
    decisions = [
        structure_from_motion(inputs),
        face_registration(inputs),
        *(part_seen(part, seen) for part in SEEN_PARTS),
        gate(scores),
        azimuths(inputs),
        subdivision(inputs),
        gaussians(inputs, settings.edge_pixels),
        steps(inputs),
        poses_follow(inputs),
        refinement(inputs),
        test_time(inputs),
    ]
    made = {one.effect: forced(one, settings) for one in decisions}
    for part in ("face", "left_hand", "right_hand"):
        made[f"{part}_residual"] = forced(residual(inputs, part, made[f"seen_{part}"].on), settings)
    made["face_loss"] = forced(face_loss(inputs, made), settings)
    return Plan(tuple(made[name] for name in EFFECTS))


def forced(decision: Decision, settings: PlanSettings) -> Decision:
    """A decision, replaced by its setting where that is not ``auto``."""
    if decision.effect in (*GATHERED, *COUNTED):
        return decision
    choice = getattr(settings, decision.effect)
    if choice == "auto":
        return decision
    why = f"set by plan.{decision.effect}={choice}; by itself: {decision.why}"
    return dataclasses.replace(decision, on=choice == "on", why=why, forced=True)


def structure_from_motion(inputs: PlanInputs) -> Decision:
    """The decision that ingest took about the cameras."""
    record = inputs.clip.footage.camera
    source, moved = record.get("source", "known"), record.get("displacement")
    on = source in ("sfm", "rotation")
    if moved is not None:
        why = f"the background moves by {moved:.2%} of the picture in a second, so the camera " + (
            "is found from it" if on else "counts as static"
        )
    else:
        why = "ingest.cameras asked for it" if on else "the cameras are given, not found"
    as_measured = moved is not None and on == (moved >= BACKGROUND_MOTION)
    given = moved is None and source not in ("known", "pinhole")
    return Decision(
        "structure_from_motion", on, moved or 0.0, BACKGROUND_MOTION, "of the picture's longer side a second",
        why, forced=given or (moved is not None and not as_measured),
    )  # fmt: skip


def face_registration(inputs: PlanInputs) -> Decision:
    """The decision that fit took about the face."""
    found, frames = inputs.face["registered"], inputs.face["frames"]
    off = inputs.face["source"] == "off"
    why = "switched off by fit.face=off" if off else f"{found} of {frames} frames show a face to register"
    return Decision("face_registration", found > 0, found, 1.0, "frames with a face", why, forced=off)


def part_seen(effect: str, seen: Mapping[str, float]) -> Decision:
    """On if a part of the body is ever seen."""
    share = seen[effect.removeprefix("seen_")]
    why = f"at most {share:.0%} of it lies in a training frame's picture"
    return Decision(effect, share >= PART_SEEN, share, PART_SEEN, "of its vertices in one frame", why)


def residual(inputs: PlanInputs, part: str, seen: bool) -> Decision:
    """On if a part shows enough pixels for colours of its own in each frame."""
    pixels, name = part_pixels(inputs.clip, part), part.replace("_", " ")
    on = seen and pixels >= RESIDUAL_PIXELS
    if not seen:
        why = f"the {name} is never seen"
    elif not pixels:
        why = f"no detector trusts what it sees of the {name}"
    else:
        why = f"the {name} is {pixels:.0f} pixels across"
    return Decision(f"{part}_residual", on, pixels, RESIDUAL_PIXELS, "pixels across", why)


def face_loss(inputs: PlanInputs, made: Mapping[str, Decision]) -> Decision:
    """On if there is a registered face large enough to be compared."""
    pixels, registered = part_pixels(inputs.clip, "face"), made["face_registration"].on
    on = registered and made["seen_face"].on and pixels >= RESIDUAL_PIXELS
    why = f"the registered face is {pixels:.0f} pixels across" if registered else "no face was registered"
    return Decision("face_loss", on, pixels, RESIDUAL_PIXELS, "pixels across", why)


def gate(scores: np.ndarray) -> Decision:
    """On if the scores of the fitted body call for the visibility gate."""
    found = evidence_threshold(scores)
    cut = found.cut if found.closed else 0.0
    return Decision("visibility_gate", found.closed, cut, LEAST_CUT, "of the body's vertices", found.why)


def azimuths(inputs: PlanInputs) -> Decision:
    """On if a side of the body is never seen."""
    joints = rest_joints(inputs.clip.body, inputs.clip.identity)
    widest, unseen = unseen_azimuths(inputs.clip, joints)
    on = widest > UNSEEN_RANGE
    why = (
        f"{len(unseen)} of 12 sides are never seen, the widest range without a frame has {widest:.0f} degrees"
    )
    return Decision("auxiliary_views", on, widest, UNSEEN_RANGE, "degrees never seen", why, values=unseen)


def subdivision(inputs: PlanInputs) -> Decision:
    """On if there are more pixels than Gaussians, a vertex each; its value is the number of levels."""
    pixels = gaussian_pixels(inputs)
    levels = max(0, math.ceil(math.log2(pixels / GAUSSIAN_PIXELS))) if pixels else 0
    why = f"the body's vertices that a training frame shows stand {pixels:.1f} pixels apart"
    return Decision("subdivision", levels > 0, pixels, GAUSSIAN_PIXELS, "pixels apart", why, values=(levels,))


def gaussians(inputs: PlanInputs, edge_pixels: float) -> Decision:
    """On if there are more pixels than Gaussians; its values are their numbers by part of the body."""
    counts = gaussians_by_part(inputs, edge_pixels)
    pixels, total = gaussian_pixels(inputs), sum(counts.values())
    most = sorted(counts, key=lambda part: -counts[part])[:3]
    shares = ", ".join(f"{part.replace('_', ' ')} {counts[part]:,}" for part in most if counts[part])
    why = f"{total:,} Gaussians leave no edge longer than {edge_pixels:g} pixels, most of them: {shares}"
    numbers = tuple(counts[part] for part in PARTS)
    return Decision("gaussians", True, pixels, edge_pixels, "pixels between vertices", why, values=numbers)


def steps(inputs: PlanInputs) -> Decision:
    """The number of optimiser steps: more frames have more to teach, but not as many times more."""
    frames = len(inputs.clip.split.train)
    factor = min(max(math.sqrt(frames / STEPS_FRAMES), LEAST_STEPS), MOST_STEPS)
    count = 10 * round(STEPS * factor / 10)
    why = f"{frames} training frames: {count:,} steps, {count / frames:.1f} visits of each"
    return Decision("steps", True, frames, STEPS_FRAMES, "training frames", why, values=(count,))


def poses_follow(inputs: PlanInputs) -> Decision:
    """On if the pose changes enough for shape and colour to follow it."""
    change = pose_change(inputs.clip)
    why = f"the keypoints change their shape by {change:.1%} of the person's size"
    return Decision("pose_heads", change >= POSE_CHANGE, change, POSE_CHANGE, "of the person's size", why)


def refinement(inputs: PlanInputs) -> Decision:
    """On if the fit leaves the training frames' poses anything to gain."""
    pixels = mean_error(inputs, inputs.clip.split.train)
    why = f"the fit's points are {pixels:.2f} pixels off in training frames"
    return Decision("pose_refinement", pixels >= FIT_PIXELS, pixels, FIT_PIXELS, "pixels", why)


def test_time(inputs: PlanInputs) -> Decision:
    """On if held-out poses are too far off for their scores to say much of the avatar."""
    quality = inputs.clip.quality.of(inputs.clip.split.test)
    error = float(quality.reprojection.mean()) if len(quality.frames) else 0.0
    pixels = mean_error(inputs, inputs.clip.split.test)
    why = (
        f"the fit's points are {pixels:.2f} pixels off in held-out frames, {error:.1%} of the person's size"
        if inputs.clip.split.test
        else "no frame is held out"
    )
    unit = "of the person's size"
    return Decision("test_time_refinement", error >= HELD_OUT_ERROR, error, HELD_OUT_ERROR, unit, why)
