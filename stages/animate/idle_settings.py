"""Settings that were given and cannot act on this motion or this avatar."""

from __future__ import annotations

from collections.abc import Mapping

from stages.animate.motions.source import TURNTABLE
from stages.animate.settings import AnimateSettings

_SPAN = ("first_frame", "last_frame", "fps", "way")
_TURNTABLE = ("turntable_frames", "turntable_fps", "arm_angle")
_WORLDS: Mapping[str, str] = {  # kind of motion -> why its up axis is known
    TURNTABLE: "a turntable has no world of its own",
    "subject": "another subject's clip is seen as its camera saw it",
    "clip": "a clip is seen as its camera saw it",
    "peers": "a folder of <frame>.json is seen as its camera saw it",
}


def idle_settings(settings: AnimateSettings, kind: str, gated: bool) -> tuple[str, ...]:
    """A sentence for each setting that differs from its default and has no effect.

    Args:
        kind: of the motion, see ``MotionSource``.
        gated: whether there is a part of the body that the clip did not show.
    """
    reasons: dict[str, str] = {}
    if kind in _WORLDS:
        reasons["up"] = _WORLDS[kind]
    if kind == TURNTABLE:
        reasons |= dict.fromkeys(_SPAN, "a turntable stands still, for turntable_frames at turntable_fps")
    else:
        reasons |= dict.fromkeys(_TURNTABLE, "the motion is no turntable")
    if settings.camera == "clip" or (settings.camera == "front" and kind != TURNTABLE):
        reasons["turns"] = f"camera={settings.camera} does not go round"
    if not gated:
        reasons["unseen"] = "the clip showed all of the body"
    usual = AnimateSettings()
    return tuple(
        f"animate.{name}={getattr(settings, name)} has no effect: {reason}"
        for name, reason in reasons.items()
        if getattr(settings, name) != getattr(usual, name)
    )
