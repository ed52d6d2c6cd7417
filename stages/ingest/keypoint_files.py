"""Keypoints that another program has written: files or one file of a clip, as 133 points a person.

Read are, a JSON file a frame:

- a list of 133 ``[x, y, score]``, or of several such people (ExAvatar's ``keypoints_whole_body``);
- people with ``keypoints`` and ``keypoint_scores``: mmpose's inferencer (a list), its demo's results
  (``instance_info``) and its ``predictions``; points nested one level deeper are taken out;
- 134 points, DWPose's with a neck, in OpenPose's order or with the neck after COCO's 17;
- OpenPose's ``people`` with 25 or 18 body points, face and hands; a canvas that it names becomes the clip's;

and one file of the whole clip: mmpose's of a video (``frame_id`` and ``instances``), COCO's results
(``image_id`` and ``keypoints``), a list of OpenPose's frames, or a table of frames by name. Any other form is
refused by its name. Points are pixels of the source.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.clip.frame_files import ClipFrames, Match, match_files, match_names, visible_files
from pipeline.clip.keypoints import COUNT
from pipeline.errors import UserError
from pipeline.untrusted import parse_json

LARGEST = 1e6  # pixels; beyond it a coordinate is no measurement
REMEDY = "write it again as 133 [x, y, score] or as mmpose's results"
_MOST_BYTES = 16 << 20  # of a frame: mmpose writes every person
_MOST_BYTES_OF_CLIP = 1 << 30
_MOST_KEYS = 5_000_000  # of a clip
_MOST_PEOPLE = 1000  # in a frame
_SHARES = 2.0  # coordinates that are all smaller are no pixels
_SMALLEST = 16  # pixels; in smaller pictures they may be
_FEW = 5  # scored points that a person must have to be judged

_OTHER_FORMS = {
    17: "COCO's 17 body points", 18: "OpenPose's 18 body points", 21: "the 21 points of a hand",
    25: "OpenPose's 25 body points", 26: "Halpe's 26 body points", 33: "MediaPipe's 33 body points",
    68: "68 face points", 136: "Halpe's 136 points", 308: "Sapiens' 308 points", 478: "MediaPipe's face mesh",
}  # fmt: skip

# OpenPose's body points in COCO's order: nose, eyes, ears, shoulders, elbows, wrists, hips, knees, ankles.
_BODY_OF_25 = (0, 16, 15, 18, 17, 5, 2, 6, 3, 7, 4, 12, 9, 13, 10, 14, 11)
_FEET_OF_25 = (19, 20, 21, 22, 23, 24)
_BODY_OF_18 = (0, 15, 14, 17, 16, 5, 2, 6, 3, 7, 4, 11, 8, 12, 9, 13, 10)
_NECK_OF_18, _NECK_AFTER_COCO = 1, 17


@dataclasses.dataclass(frozen=True)
class GivenKeypoints:
    """The keypoints of a clip's frames.

    Attributes:
        files: frame number -> the file that has them, for messages too.
        tables: frame number -> its people, where one file is the whole clip's; else empty.
    """

    files: Mapping[int, Path]
    tables: Mapping[int, Any] = dataclasses.field(default_factory=dict)

    def people(self, frame: int, size: tuple[int, int]) -> np.ndarray:
        """The people in a frame, [P, 133, 3] float32; ``size`` is the picture's width and height."""
        path = self.files[frame]
        value = self.tables[frame] if self.tables else parse_json(path, REMEDY, _MOST_BYTES)
        return people_in(value, path, size)


def open_keypoints(
    path: Path, clip: ClipFrames, counted_from: int | None = None
) -> tuple[GivenKeypoints, Match]:
    """Match a folder of files a frame, or one file of the whole clip, to the clip's frames.

    Raises:
        UserError: nothing of use is there, or it is ambiguous.
    """
    files = visible_files(path, (".json",)) if path.is_dir() else [path]
    if not files:
        kinds = sorted({file.suffix for file in path.iterdir() if file.is_file() and file.suffix})
        others = f" (but {', '.join(kinds[:4])} files)" if kinds else ""
        raise UserError(f"{path} holds no numbered .json file{others}: check ingest.keypoints")
    if len(files) == 1:
        tables = _tables(files[0])
        if tables is not None:
            names = match_names(tables, clip, files[0], counted_from)
            of_frames = {frame: tables[name] for name, frame in names.frames.items()}
            return GivenKeypoints(dict.fromkeys(of_frames, files[0]), of_frames), names
    if not path.is_dir():
        raise UserError(f"{path} is of one frame: ingest.keypoints is a folder of such files, one a frame")
    found, match = match_files(path, (".json",), clip, counted_from)
    if not found and not match.strangers:
        raise UserError(f"{path} holds no numbered .json file: check ingest.keypoints")
    return GivenKeypoints(found), match


def _tables(path: Path) -> dict[str, Any] | None:
    """Frame name -> people, of a file of a whole clip; None where it is of one frame."""
    value = parse_json(path, REMEDY, _MOST_BYTES_OF_CLIP, _MOST_KEYS)
    if isinstance(value, dict):
        if isinstance(value.get("instance_info"), list):
            return _by_frame_id(value["instance_info"])
        named = bool(value) and all(isinstance(people, list) for people in value.values())
        return dict(value) if named and all(any(map(str.isdigit, name)) for name in value) else None
    if not isinstance(value, list) or not value or not all(isinstance(one, dict) for one in value):
        return None
    if all("image_id" in one for one in value):
        tables: dict[str, Any] = {}
        for one in value:
            tables.setdefault(str(one["image_id"]), []).append(one)
        return tables
    if len(value) > 1 and all("people" in one for one in value):
        return {str(place): one for place, one in enumerate(value)}
    return _by_frame_id(value)


def _by_frame_id(entries: list[Any]) -> dict[str, Any] | None:
    needed = {"frame_id", "instances"}
    if not entries or not all(isinstance(one, dict) and needed <= set(one) for one in entries):
        return None
    return {str(one["frame_id"]): one["instances"] for one in entries}


def people_in(value: Any, path: Path, size: tuple[int, int]) -> np.ndarray:
    """The people that a frame's JSON holds, [P, 133, 3] float32: x, y in pixels, score in [0, 1].

    Args:
        value: the JSON.
        path: its file, for messages.
        size: width and height of the picture, pixels.

    Raises:
        UserError: another form, which is named; numbers that are null, not finite, beyond ``LARGEST``, or
            shares of the picture.
    """
    people = [_whole_body(points, path) for points in _people(value, path, size)]
    if len(people) > _MOST_PEOPLE:
        raise UserError(f"{path} holds {len(people)} people, more than {_MOST_PEOPLE}: {REMEDY}")
    for points in people:
        _check_unit(points, path, size)
    return np.stack(people) if people else np.zeros((0, COUNT, 3), np.float32)


def _people(value: Any, path: Path, size: tuple[int, int]) -> list[np.ndarray]:
    """People as [K, 3] float64 of any K."""
    if isinstance(value, dict):
        return _people_of_table(value, path, size)
    if not isinstance(value, list):
        raise _refusal(path, "no list of points")
    if value and all(isinstance(one, dict) for one in value):
        return [points for one in value for points in _people_of_table(one, path, size)]
    if len(value) == 1 and isinstance(value[0], list) and value[0] and isinstance(value[0][0], dict):
        return _people(value[0], path, size)
    if not value:
        raise _refusal(path, "an empty list")
    array = _array(value, path)
    if array.ndim == 3 and array.shape[2] == 3:
        return list(array)
    if array.ndim == 2 and array.shape[1] == 2:
        raise _refusal(path, f"{len(array)} points without scores")
    if array.ndim != 2 or array.shape[1] != 3:
        raise _refusal(path, f"numbers of the shape {list(array.shape)}")
    return [array]


def _people_of_table(table: dict[str, Any], path: Path, size: tuple[int, int]) -> list[np.ndarray]:
    for key in ("instance_info", "instances", "predictions"):
        if key in table:
            if not isinstance(table[key], list):
                raise _refusal(path, f"an '{key}' that is no list of people")
            return _people(table[key], path, size) if table[key] else []
    if "people" in table:
        return _openpose(table, path, size)
    if {"bodies", "hands", "faces"} <= set(table):
        raise _refusal(path, "DWPose's drawing (bodies, hands and faces as shares of the picture)")
    if "keypoints" not in table:
        known = ", ".join(sorted(map(str, table))[:6]) or "nothing"
        raise _refusal(path, f"a table of {known}")
    return _scored(table, path)


def _scored(table: dict[str, Any], path: Path) -> list[np.ndarray]:
    """People of ``keypoints`` and their scores, or with the scores in them."""
    points = _array(table["keypoints"], path)
    scores = table.get("keypoint_scores", table.get("scores"))
    if scores is None:
        if points.ndim == 1 and points.size % 3 == 0:
            return [points.reshape(-1, 3)]
        if points.ndim < 2 or points.shape[-1] != 3:
            raise _refusal(path, "a person without matching 'keypoints' and 'keypoint_scores'")
        return list(points.reshape(-1, *points.shape[-2:]))
    weights = _array(scores, path)
    if points.ndim > 1 and weights.size == points[..., 0].size:
        weights = weights.reshape(points.shape[:-1])
    if points.ndim < 2 or points.shape[:-1] != weights.shape or points.shape[-1] < 2:
        raise _refusal(path, "a person without matching 'keypoints' and 'keypoint_scores'")
    joined = np.concatenate([points[..., :2], weights[..., None]], axis=-1)
    return list(joined.reshape(-1, *joined.shape[-2:]))


def _openpose(table: dict[str, Any], path: Path, size: tuple[int, int]) -> list[np.ndarray]:
    """OpenPose's people: parts are flat lists of x, y, score."""
    people = table["people"]
    if not isinstance(people, list) or not all(isinstance(one, dict) for one in people):
        raise _refusal(path, "'people' that are no list of tables")
    canvas = [table.get(name) for name in ("canvas_width", "canvas_height")]
    named = all(isinstance(side, int | float) and side > 0 for side in canvas)
    found = []
    for one in people:
        parts = {
            name: _array(one.get(f"{name}_keypoints_2d") or [], path).reshape(-1)
            for name in ("pose", "face", "hand_left", "hand_right")
        }
        if any(part.size % 3 for part in parts.values()):
            raise _refusal(path, "OpenPose's people, of which one has no x, y, score")
        points = {name: part.reshape(-1, 3) for name, part in parts.items()}
        whole = _from_openpose(points, path)
        if named:  # shares of the canvas, or its pixels
            shares = np.abs(whole[:, :2]).max() <= _SHARES and max(size) > _SMALLEST
            whole[:, :2] *= np.array(size) / (1 if shares else np.array(canvas, float))
        found.append(whole)
    return found


def _from_openpose(points: Mapping[str, np.ndarray], path: Path) -> np.ndarray:
    whole = np.zeros((COUNT, 3))
    body = points["pose"]
    if len(body) not in (18, 25):
        raise _refusal(path, f"OpenPose's people with {len(body)} body points, not 18 or 25,")
    whole[:17] = body[list(_BODY_OF_25 if len(body) == 25 else _BODY_OF_18)]
    if len(body) == 25:
        whole[17:23] = body[list(_FEET_OF_25)]
    for name, begin, count in (("face", 23, 68), ("hand_left", 91, 21), ("hand_right", 112, 21)):
        part = points[name]
        if len(part):
            if len(part) < count:
                raise _refusal(path, f"OpenPose's people with {len(part)} points of {name}")
            whole[begin : begin + count] = part[:count]  # of the face's 70 the last two are the pupils
    return whole


def _array(value: Any, path: Path) -> np.ndarray:
    """Numbers as float64, without leading axes of length one."""
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise _refusal(path, "something else than numbers") from None
    while array.ndim > 2 and array.shape[0] == 1:
        array = array[0]
    return array


def _whole_body(points: np.ndarray, path: Path) -> np.ndarray:
    """One person's points [K, 3] as 133 with scores in [0, 1], float32."""
    if len(points) == COUNT + 1:
        points = _without_neck(points, path)
    if points.shape != (COUNT, 3):
        form = _OTHER_FORMS.get(len(points), f"{len(points)} points")
        raise _refusal(path, form)
    bad = np.flatnonzero(~(np.abs(points) < LARGEST).all(1))
    if len(bad):
        raise UserError(f"{path}: point {bad[0]} is not finite or lies beyond {LARGEST:.0f} px: {REMEDY}")
    clipped = points.astype(np.float32)
    clipped[:, 2] = np.clip(points[:, 2], 0, 1)
    return clipped


def _without_neck(points: np.ndarray, path: Path) -> np.ndarray:
    """134 points as 133: the neck, half-way between the shoulders, tells the order of the body's."""
    rest = points[18:]
    in_coco = points[:17]
    in_openpose = points[list(_BODY_OF_18)]
    orders = ((in_openpose, points[_NECK_OF_18]), (in_coco, points[_NECK_AFTER_COCO]))
    scored = [body[5:7, 2].min() > 0 and neck[2] > 0 for body, neck in orders]
    if not any(scored):
        return np.concatenate([in_openpose, rest])
    away = [
        float(np.abs(body[5:7, :2].mean(0) - neck[:2]).max()) if known else np.inf
        for (body, neck), known in zip(orders, scored, strict=True)
    ]
    best = int(np.argmin(away))
    extent = float(np.ptp(points[points[:, 2] > 0, :2], axis=0).max())
    if away[best] > 0.02 * max(extent, 1e-6):
        raise _refusal(path, "134 points of which none is a neck between the shoulders (as DWPose has it)")
    return np.concatenate([orders[best][0], rest])


def _check_unit(points: np.ndarray, path: Path, size: tuple[int, int]) -> None:
    """Refuse shares of the picture."""
    scored = points[points[:, 2] > 0, :2]
    if len(scored) >= _FEW and max(size) > _SMALLEST and np.abs(scored).max() <= _SHARES:
        raise UserError(
            f"{path}: its points lie between {scored.min():.2f} and {scored.max():.2f}, which are shares of "
            f"the picture and not pixels: multiply x by {size[0]} and y by {size[1]}"
        )


def _refusal(path: Path, form: str) -> UserError:
    return UserError(f"{path} does not hold {COUNT} points of x, y, score, but {form}: {REMEDY}")
