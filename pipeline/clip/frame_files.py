"""The frame of a clip that a file means: one rule for frames, masks, keypoints, cameras and poses.

1. **Equal names.** Where the clip is pictures, ``masks/frame_10.png`` belongs to ``frames/frame_10.jpg``. So
   does ``00010.jpg.png``, and so do ``frame_10_keypoints.json`` and ``results_frame_10.json`` where all files
   have the same before or after the picture's name.
2. **Numbers.** Of several runs of digits in a name, the frame's number is the one that tells the files
   apart: ``0000_person1.json`` is 0, ``clip2_000000000010_keypoints.json`` is 10. Where the clip is pictures
   that have numbers in their names, equal numbers belong together (``7.json`` and ``image_0007.png``), if all
   do. Otherwise numbers are places in the clip, counted from 0 or from 1: from 0 where there is a file 0;
   from 1 where one has the number of all frames, or where 1 is the least (FFmpeg counts so).
3. What is left is a stranger, and the caller refuses it by name.

Nothing here depends on ``ingest.stride`` or ``ingest.max_frames``: numbers are those of the whole source.
Pictures of a folder stand in natural order, ``frame_2`` before ``frame_10``.
"""

from __future__ import annotations

import dataclasses
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePath

from pipeline.errors import UserError

EQUAL_NAMES, EQUAL_NUMBERS = "by equal names", "by equal numbers in the names"
_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]{0,7}$")  # ".png", not the ".0001" of "take.0001"
_DIGITS = re.compile(r"[0-9]+")
_BESIDE = "_-. "  # what may stand between a picture's name and what another program adds to it


@dataclasses.dataclass(frozen=True)
class ClipFrames:
    """The frames of a clip and what they are called.

    Attributes:
        numbers: the frames' numbers, increasing; empty where nobody knows how many a video has.
        names: frame number -> the picture's file name, for all frames; empty for a video.
    """

    numbers: Sequence[int]
    names: Mapping[int, str] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Match:
    """Files and the frames that they mean.

    Attributes:
        frames: file name -> frame number, in the order of the frames.
        strangers: names of no frame, in natural order; names without a number are in neither.
        how: the rule, in words for the log.
        counted_from: the first frame's number where numbers are places, else None.
    """

    frames: Mapping[str, int]
    strangers: tuple[str, ...]
    how: str
    counted_from: int | None = None


def stem_of(name: str) -> str:
    """A file's name without folders (of either slash) and without its last suffix."""
    return _SUFFIX.sub("", PurePath(name.replace("\\", "/")).name)


def natural_key(name: str) -> tuple[tuple[str | int, ...], str]:
    """A key by which ``frame_2`` comes before ``frame_10``."""
    parts = re.split(r"([0-9]+)", name)
    return tuple(int(part) if place % 2 else part for place, part in enumerate(parts)), name


def visible_files(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """The files of a folder with one of some suffixes, in natural order; empty without such a folder."""
    found = [] if not folder.is_dir() else list(folder.iterdir())
    chosen = [file for file in found if file.suffix.lower() in suffixes and not file.name.startswith(".")]
    return sorted(chosen, key=lambda file: natural_key(file.name))


def numbers_in(names: Iterable[str]) -> dict[str, int]:
    """The number in each of a folder's file names; names without digits are left out.

    Names are compared with those that differ from them in digits alone. Of the runs of digits the one with
    the most values counts; of equals the one whose values lie closest together, then the longest, then one
    that does not follow a letter, then the last.
    """
    alike: dict[str, list[str]] = defaultdict(list)
    for name in names:
        alike[_DIGITS.sub("#", stem_of(name))].append(name)
    found = {}
    for group in alike.values():
        runs = {name: list(_DIGITS.finditer(stem_of(name))) for name in group}
        count = len(runs[group[0]])
        if not count:
            continue

        def worth(place: int, runs: dict[str, list[re.Match[str]]] = runs) -> tuple[int, ...]:
            texts = [run[place].group() for run in runs.values()]
            values = {int(text) for text in texts}
            one = next(iter(runs.values()))[place]
            glued = one.start() > 0 and one.string[one.start() - 1].isalpha()
            return len(values), min(values) - max(values), max(map(len, texts)), not glued, place

        best = max(range(count), key=worth)
        found.update({name: int(run[best].group()) for name, run in runs.items()})
    return found


def number_files(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Frame number -> file, by the numbers in the names, sorted; empty without such a folder.

    For a folder whose names say which frames there are. Names without a number are left out.

    Raises:
        UserError: two files of one frame.
    """
    files = {file.name: file for file in visible_files(folder, suffixes)}
    frames = _distinct(numbers_in(files), folder)
    return {frame: files[name] for name, frame in frames.items()}


def frame_files(
    folder: Path,
    suffixes: Sequence[str],
    clip: ClipFrames | None,
    counted_from: int | None = None,
    log: Callable[[str], None] = lambda line: None,
) -> dict[int, Path]:
    """Frame number -> file, of a folder whose files may be of other frames too, sorted.

    Args:
        clip: all frames of the footage, which the names mean; None: their numbers are frame numbers.
        counted_from: the first frame's number where the user says so.
        log: told in one line how files were matched, where ``clip`` says to what.

    Raises:
        UserError: two files of one frame.
    """
    if clip is None:
        return number_files(folder, suffixes)
    files, match = match_files(folder, suffixes, clip, counted_from)
    log(f"{folder.name}: {describe_match(match, clip)}")
    return files


def match_files(
    folder: Path, suffixes: Sequence[str], clip: ClipFrames, counted_from: int | None = None
) -> tuple[dict[int, Path], Match]:
    """The files of a folder by frame number, sorted, and how they were matched; see :func:`match_names`."""
    files = {file.name: file for file in visible_files(folder, suffixes)}
    match = match_names(files, clip, folder, counted_from)
    return {frame: files[name] for name, frame in match.frames.items()}, match


def match_names(
    names: Iterable[str], clip: ClipFrames, where: Path, counted_from: int | None = None
) -> Match:
    """The frames that file names mean; the module's docstring has the rule.

    Args:
        names: of files, with or without folders and suffixes.
        clip: its frames.
        where: the folder or file that has the names, for messages.
        counted_from: the first frame's number where the user says so; then numbers are places in the clip,
            whatever the names.

    Raises:
        UserError: two names of one frame.
    """
    ordered = sorted(set(names), key=natural_key)
    numbers = numbers_in(ordered)
    if clip.names and counted_from is None:
        found = _by_name(ordered, numbers, clip, where)
        if found is not None:
            return found
    elif counted_from is not None:
        return _by_place(numbers, clip, where, counted_from)
    own = _own_numbers(clip)
    if numbers and own and all(number in own for number in numbers.values()):
        return _matched({name: own[number] for name, number in numbers.items()}, (), EQUAL_NUMBERS, where)
    if not numbers:
        return Match({}, (), "not at all, no name has a number")
    placed = _by_place(numbers, clip, where, _first_of(numbers.values(), len(clip.numbers)))
    if not placed.strangers:
        return placed
    if any(number in own for number in numbers.values()):
        known = {name: own[number] for name, number in numbers.items() if number in own}
        return _matched(known, [name for name in numbers if name not in known], EQUAL_NUMBERS, where)
    return placed


def describe_match(match: Match, clip: ClipFrames) -> str:
    """How files were matched, for the log: ``16 files of 16 frames, by number, counted from 1``."""
    count, of = len(match.frames), f" of {len(clip.numbers)} frames" if clip.numbers else ""
    left = f"; {len(match.strangers)} of no frame" if match.strangers else ""
    return f"{count} files{of}, matched {match.how}{left}"


def _by_name(ordered: list[str], numbers: Mapping[str, int], clip: ClipFrames, where: Path) -> Match | None:
    """Rule 1; None where no name is a picture's."""
    own = {stem_of(picture): frame for frame, picture in clip.names.items()}
    whole = {PurePath(picture).name: frame for frame, picture in clip.names.items()}
    found = {}
    for name in ordered:
        frame = own.get(stem_of(name), whole.get(stem_of(name)))
        if frame is not None:
            found[name] = frame
    if not found:
        return _by_longer_name(ordered, numbers, own, where)
    # "8.png" beside "10.png" where the pictures are 08.jpg and 10.jpg: the same numbers, written otherwise.
    by_number, taken = _own_numbers(clip), set(found.values())
    rest = [name for name in ordered if name not in found and name in numbers]
    more = {name: by_number[numbers[name]] for name in rest if numbers[name] in by_number}
    found.update({name: frame for name, frame in more.items() if frame not in taken})
    return _matched(found, [name for name in rest if name not in found], EQUAL_NAMES, where)


def _by_longer_name(
    ordered: list[str], numbers: Mapping[str, int], own: Mapping[str, int], where: Path
) -> Match | None:
    """The names that are a picture's with the same text added to each, before or after; None otherwise."""
    found = {}
    for name in [name for name in ordered if name in numbers] or ordered:
        stem = stem_of(name)
        cuts = [place for place, letter in enumerate(stem) if letter in _BESIDE]
        parts = [(("", stem[cut:]), stem[:cut]) for cut in cuts]
        parts += [((stem[: cut + 1], ""), stem[cut + 1 :]) for cut in cuts]
        found[name] = {added: own[part] for added, part in parts if part in own}
    shared = set.intersection(*(set(frames) for frames in found.values())) if found else set()
    if not shared:
        return None
    added = min(shared, key=lambda pair: (len(pair[0]) + len(pair[1]), pair))
    frames = {name: frames[added] for name, frames in found.items()}
    return _matched(frames, (), f"{EQUAL_NAMES}, but for '{added[0] or added[1]}'", where)


def _own_numbers(clip: ClipFrames) -> dict[int, int]:
    """Number in a picture's name -> frame; empty where they do not tell all pictures apart."""
    numbers = numbers_in(clip.names.values())
    own = {numbers[name]: frame for frame, name in clip.names.items() if name in numbers}
    return own if len(own) == len(clip.names) else {}


def _first_of(numbers: Iterable[int], count: int) -> int:
    """The number that the first frame has: 0 or 1. ``count`` is how many frames there are, 0 if unknown."""
    numbers = set(numbers)
    least, largest = min(numbers), max(numbers)
    return int(least > 0 and (largest == count or (least == 1 and (not count or largest < count))))


def _by_place(numbers: Mapping[str, int], clip: ClipFrames, where: Path, first: int) -> Match:
    places = {name: number - first for name, number in numbers.items()}
    known, length = clip.numbers, len(clip.numbers)
    found = {
        name: known[place] if known else place
        for name, place in places.items()
        if 0 <= place and (place < length or not known)
    }
    how = f"by number, counted from {first}"
    least, largest = min(numbers.values(), default=0), max(numbers.values(), default=0)
    if least > 0 and not (first == 1 and known and largest == length):
        how += f" (no name has 0{'' if first and least == 1 else f' or {length}' if known else ''})"
    strangers = [name for name in numbers if name not in found]
    return dataclasses.replace(_matched(found, strangers, how, where), counted_from=first)


def _matched(frames: Mapping[str, int], strangers: Iterable[str], how: str, where: Path) -> Match:
    return Match(_distinct(frames, where), tuple(sorted(strangers, key=natural_key)), how)


def _distinct(frames: Mapping[str, int], where: Path) -> dict[str, int]:
    """The same, sorted by frame; UserError where two names mean one frame."""
    first: dict[int, str] = {}
    for name, frame in sorted(frames.items(), key=lambda item: natural_key(item[0])):
        if frame in first:
            raise UserError(f"{where}: '{first[frame]}' and '{name}' both name frame {frame}: keep one")
        first[frame] = name
    return {first[frame]: frame for frame in sorted(first)}
