"""The body's joints in captured skeletons, whatever their names follow.

Names of the programs in common use are known: Mixamo, MotionBuilder, CMU (BVH and ASF), LaFAN1, 3ds Max's
Biped, Daz and Poser, Unreal, Unity and VRM, Blender's Rigify and MakeHuman, Xsens, ARKit, Reallusion, SMPL.
Before they are looked up, a namespace (``mixamorig:``, ``Armature|``), spaces, points, underscores, case, and
the prefix that most names share are taken off.

One word means different joints in different programs (SMPL's ``left_foot`` is Mixamo's ``LeftToeBase``; a
``LeftShoulder`` may be the collar), so each limb's names are read together: along the skeleton, as many
joints as can be are given to the schema's in order, and among equals the usual meaning counts.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence

from pipeline.body.joints import FINGERS, JOINT_NAMES
from pipeline.errors import UserError

_SIDES = {"left": ("left", "l"), "right": ("right", "r")}
_LEG = {  # joint -> words, the most usual first
    "hip": (
        "upleg", "thigh", "hip", "upperleg", "femur", "thighbend", "upperleg1", "uleg", "leg", "hipjoint",
    ),
    "knee": ("leg", "knee", "shin", "calf", "lowleg", "lowerleg", "tibia", "lowerleg1", "lleg"),
    "ankle": ("ankle", "foot"),
    "foot": (
        "toebase", "toe", "toes", "ball", "toe0", "toesbase", "ballfoot", "forefoot", "metatarsals", "toe1",
        "foot",
    ),
}  # fmt: skip
_ARM = {
    "collar": (
        "collar", "clavicle", "collarbone", "shoulder", "scapula", "thorax", "clavicle1", "shoulder1",
        "shoulderblade",
    ),
    "shoulder": (
        "arm", "uparm", "upperarm", "shldr", "humerus", "shldrbend", "upperarm1", "uarm", "shoulder",
    ),
    "elbow": ("forearm", "elbow", "lowarm", "lowerarm", "radius", "forearmbend", "lowerarm1", "farm"),
    "wrist": ("wrist", "hand"),
}  # fmt: skip
_FINGER_WORDS = {
    "index": ("index",), "middle": ("middle", "mid"), "pinky": ("pinky", "little", "pinkie"),
    "ring": ("ring",), "thumb": ("thumb",),
}  # fmt: skip
_BIPED_FINGERS = ("thumb", "index", "middle", "ring", "pinky")  # Finger0, Finger01, Finger02; Finger1, ...
_PELVIS = ("hips", "pelvis", "hip", "root")
_NECK = (
    "neck",
    "neck1",
    "necklower",
    "lowerneck",
    "necktwist1",
    "spine004",
    "neckbase",
    "upperneck",
    "neck2",
)
_HEAD = ("head", "spine006", "skull")
_SPINE = {  # joint -> words, the most usual first
    "spine1": (
        "spine",
        "abdomen",
        "lowerback",
        "waist",
        "torso",
        "spine1",
        "lowerspine",
        "abdomenlower",
        "l5",
    ),
    "spine2": ("spine1", "chest", "spine2", "upperback", "abdomenupper", "midspine", "l3"),
    "spine3": ("spine2", "chest2", "spine3", "upperchest", "thorax", "chestupper", "upperspine", "t8"),
}
_MORE_SPINE = (
    "back", "ab", "stomach", "belly", "chestlower", "lowerchest", "spinelower", "spineupper", "spinemid",
    "midback", "ribcage", "ribs", "t12", "t10",
)  # fmt: skip
_NUMBERED = ("spine", "chest", "abdomen", "torso", "back", "waist")
_NEEDED = ("pelvis", *(f"{side}_{part}" for part in ("hip", "shoulder", "elbow") for side in _SIDES))
_LIMB_NEEDS = ("hip", "shoulder", "elbow")
_USELESS = re.compile(r"(jnt|joint|bone|bind|def|skin|drv|sc)$")
_NUMBER = re.compile(r"[_.]\d+$")  # what Sketchfab puts at the end of every name
_MOST_LETTERS = 100  # of a name that is looked at
_UNUSUAL = 99  # the rank of a word that is known to mean a joint of the spine, but not which
_MOST_OPTIONS = 6  # names that are tried for one joint


@dataclasses.dataclass(frozen=True)
class _Role:
    """What a word may mean: a part of one side (or of none), and how usual that is; 0 is the most."""

    side: str
    part: str
    rank: int


def match_joints(
    names: Sequence[str], parents: Sequence[int], origin: str = "the BVH skeleton"
) -> dict[str, int]:
    """SMPL-X joint -> place in a capture's list of joints.

    Args:
        names: the capture's joints, parents before children.
        parents: each joint's parent, -1 for a root.
        origin: the file, for the message.

    Raises:
        UserError: pelvis, hips, shoulders or elbows are not among them.
    """
    tree = _Tree(parents)
    candidates = max((_candidates(one) for one in _variants(names)), key=len)
    places: dict[tuple[str, str], list[tuple[int, int]]] = defaultdict(list)  # (side, part) -> (rank, place)
    for place, roles in candidates.items():
        for role in roles:
            places[role.side, role.part].append((role.rank, place))
    found: dict[str, int] = {}
    for side in _SIDES:
        for chain in _CHAINS:
            options = [sorted(places[side, part]) for part in chain]
            for part, joint in zip(chain, _along(options, chain, tree), strict=True):
                if joint is not None:
                    found[f"{side}_{part}"] = joint
    found |= _middle(places, found, tree)
    _check(names, found, origin)
    return {joint: found[joint] for joint in JOINT_NAMES if joint in found}


class _Tree:
    """The skeleton's ancestors."""

    def __init__(self, parents: Sequence[int]) -> None:
        self._parents = parents

    def line(self, place: int) -> list[int]:
        """A joint and all above it, itself first."""
        line = [place]
        while self._parents[line[-1]] >= 0:
            line.append(self._parents[line[-1]])
        return line

    def is_below(self, place: int, above: int) -> bool:
        """True if a joint hangs from another one."""
        return place != above and above in self.line(place)

    def shared(self, places: Sequence[int]) -> list[int]:
        """The joints from which all of some hang, the lowest first; a joint hangs from itself."""
        lines = [self.line(place) for place in places] or [[]]
        rest = [set(line) for line in lines[1:]]
        return [place for place in lines[0] if all(place in line for line in rest)]


def _check(names: Sequence[str], found: Mapping[str, int], origin: str) -> None:
    missing = [joint for joint in _NEEDED if joint not in found]
    if missing:
        shown = ", ".join(name[:40] for name in names[:12])
        raise UserError(
            f"{origin} has no joint known as {', '.join(missing)} (it has {shown}, ...): "
            "name its joints as Mixamo does"
        )


def _middle(
    places: Mapping[tuple[str, str], list[tuple[int, int]]], limbs: Mapping[str, int], tree: _Tree
) -> dict[str, int]:
    """Pelvis, spine, neck and head, by their names and from where the limbs hang."""
    found: dict[str, int] = {}
    hips = [limbs[name] for name in ("left_hip", "right_hip") if name in limbs]
    shared = [place for place in tree.shared(hips) if place not in hips]
    named = [place for _, place in sorted(places["", "pelvis"])]
    pelvis = [place for place in named if place in shared] or shared or named
    if pelvis:
        found["pelvis"] = pelvis[0]
    taken = {*limbs.values(), *found.values()}
    for part in ("neck", "head"):
        place = next((place for _, place in sorted(places["", part]) if place not in taken), None)
        if place is not None:
            found[part] = place
            taken.add(place)
    return found | _spine(places, limbs, taken, tree.line(pelvis[0]) if pelvis else [], tree)


def _spine(
    places: Mapping[tuple[str, str], list[tuple[int, int]]],
    limbs: Mapping[str, int],
    taken: set[int],
    pelvis: Sequence[int],
    tree: _Tree,
) -> dict[str, int]:
    """Joints of the spine; of more than three the lowest, one between, and the one that carries the arms.

    Args:
        limbs: the joints of arms and legs.
        taken: joints that are something else.
        pelvis: the pelvis and what is above it.
    """
    arms = [limbs[name] for name in ("left_collar", "right_collar") if name in limbs]
    arms = (
        arms
        if len(arms) > 1
        else [limbs[f"{side}_shoulder"] for side in _SIDES if f"{side}_shoulder" in limbs]
    )
    known = {place for part in (*_SPINE, "spine") for _, place in places["", part]} - taken - {*pelvis}
    line = [place for place in reversed(tree.shared(arms)) if place in known] or sorted(known)
    if len(line) > len(_SPINE):
        line = [line[0], line[(len(line) - 1) // 2], line[-1]]
    ranks = {part: {place: rank for rank, place in reversed(sorted(places["", part]))} for part in _SPINE}
    best = min(
        itertools.combinations(_SPINE, len(line)),
        key=lambda parts: sum(
            ranks[part].get(place, _UNUSUAL) for part, place in zip(parts, line, strict=True)
        ),
    )
    return dict(zip(best, line, strict=True))


def _along(
    options: Sequence[Sequence[tuple[int, int]]], chain: Sequence[str], tree: _Tree
) -> tuple[int | None, ...]:
    """One place, or None, for each joint of a chain, so that each hangs from those before it.

    Args:
        options: for each joint of the chain (rank, place), sorted.
    """
    best: tuple[tuple[int, int, int], tuple[int | None, ...]] | None = None
    choices = [[*own[:_MOST_OPTIONS], None] for own in options]
    for choice in itertools.product(*choices):
        taken = [place for one in choice if one is not None for place in one[1:]]
        if any(not tree.is_below(low, high) for high, low in itertools.pairwise(taken)):
            continue
        lacking = sum(one is None and part in _LIMB_NEEDS for one, part in zip(choice, chain, strict=True))
        cost = (lacking, -len(taken), sum(one[0] for one in choice if one is not None))
        if best is None or cost < best[0]:
            best = cost, tuple(None if one is None else one[1] for one in choice)
    return best[1] if best is not None else (None,) * len(chain)


def _variants(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """The names without namespaces, as they are and without a number at the end."""
    bare = [re.split(r"[:|]", name)[-1][-_MOST_LETTERS:] for name in names]
    return bare, [_NUMBER.sub("", name) for name in bare]


def _candidates(names: Sequence[str]) -> dict[int, tuple[_Role, ...]]:
    """Place -> what its name may mean; the first joint of each name alone."""
    plain = [re.sub(r"[\W_]", "", name).lower() for name in names]
    prefix = _prefix(plain)
    found: dict[int, tuple[_Role, ...]] = {}
    seen = set()
    for place, name in enumerate(plain):
        word = name.removeprefix(prefix)
        roles = _roles(word) or _roles(name)
        if roles and word not in seen:
            found[place] = roles
            seen.add(word)
    return found


def _prefix(names: Sequence[str]) -> str:
    """What stands before the most known words; nothing where that does as well."""
    known: dict[str, set[tuple[_Role, ...]]] = defaultdict(set)
    for name in names:
        for start in range(len(name)):
            roles = _roles(name[start:])
            if roles:
                known[name[:start]].add(roles)
    return min(known, key=lambda prefix: (-len(known[prefix]), len(prefix)), default="")


def _roles(word: str) -> tuple[_Role, ...]:
    """What a word may mean, also with its numbers' leading zeros or a word such as ``joint`` at the end."""
    plain = re.sub(r"0+(?=\d)", "", word)
    return _ROLES.get(word) or _ROLES.get(plain) or _ROLES.get(_USELESS.sub("", plain), ())


def _finger_words(finger: str, k: int) -> tuple[str, ...]:
    names = _FINGER_WORDS[finger]
    phalanges = ("proximal", "intermediate", "distal")
    latin = [phalanges[k - 1]]
    if finger == "thumb":  # Unity's begins with proximal, VRM's with metacarpal
        latin = [*latin, ("metacarpal", "proximal", "distal")[k - 1]]
    number = _BIPED_FINGERS.index(finger)
    return (
        *(f"hand{name}{k}" for name in names),
        *(f"{name}{k}" for name in names),
        *(f"f{name}{k}" for name in names),
        *(f"{name}finger{k}" for name in names),
        *(f"{name}{word}" for name in names for word in latin),
        *(f"hand{name}{word}" for name in names for word in latin),
        f"finger{number}" if k == 1 else f"finger{number}{k - 1}",
        *(names if k == 1 else ()),
    )


def _all_roles() -> dict[str, tuple[_Role, ...]]:
    """Every word that is known -> what it may mean."""
    found: dict[str, list[_Role]] = defaultdict(list)
    sided = {**_LEG, **_ARM} | {
        f"{finger}{k}": _finger_words(finger, k) for finger in FINGERS for k in (1, 2, 3)
    }
    for part, words in sided.items():
        for rank, word in enumerate(words):
            for side, marks in _SIDES.items():
                for form in {form for mark in marks for form in (mark + word, word + mark)}:
                    found[form].append(_Role(side, part, rank))
    spine = {*_MORE_SPINE, *(f"{word}{k}" for word in _NUMBERED for k in range(10))}
    middle = {"pelvis": _PELVIS, **_SPINE, "spine": (*_MORE_SPINE, *sorted(spine - {*_MORE_SPINE}))}
    for part, words in {**middle, "neck": _NECK, "head": _HEAD}.items():
        for rank, word in enumerate(words):
            for form in (word, f"c{word}"):
                found[form].append(_Role("", part, rank))
    return {word: tuple(roles) for word, roles in found.items()}


_CHAINS = (
    tuple(_LEG),
    tuple(_ARM),
    *(tuple(f"{finger}{k}" for k in (1, 2, 3)) for finger in FINGERS),
)
_ROLES = _all_roles()
