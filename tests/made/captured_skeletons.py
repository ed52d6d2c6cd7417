"""Captured skeletons as programs name and build them, and the body's own motion written as any of them."""

import itertools

import numpy as np
import roma
import torch

from pipeline.body import JOINT_NAMES, joint_index, rest_joints

FPS = 30.0
_CHAINS = (
    ("pelvis", "spine1", "spine2", "spine3", "neck", "head"),
    ("collar", "shoulder", "elbow", "wrist"),
    ("hip", "knee", "ankle", "foot"),
)
_FINGERS = tuple(
    f"{finger}{k}" for finger in ("thumb", "index", "middle", "ring", "pinky") for k in (1, 2, 3)
)


def _skeleton(side, trunk, arm, leg, fingers=None):
    """Joint -> name, for a convention.

    Args:
        side: (side, word) -> a sided joint's name.
        trunk, arm, leg: names along the chain, in order; "-" for a joint that it lacks, ``~name`` for one
            that it has besides.
        fingers: finger joint -> word.
    """
    names = {}
    for joints, words in zip(_CHAINS, (trunk, arm, leg), strict=True):
        joints, pending = iter(joints), []
        for word in words.split():
            if word.startswith("~"):
                pending.append(word)
                continue
            joint = next(joints)
            if word == "-":
                continue
            names[joint] = [*pending, word]
            pending, last = [], joint
        if pending:
            names[last] += pending
    names |= {joint: [fingers(joint)] for joint in _FINGERS} if fingers else {}
    found = {}
    for joint in JOINT_NAMES:
        which, _, part = joint.partition("_")
        own = names.get(part or joint, [])
        found[joint] = [
            word[:1] * word.startswith("~") + (side(which, word.lstrip("~")) if part else word.lstrip("~"))
            for word in own
        ]
    return {joint: words for joint, words in found.items() if words}


def _named(prefix, words):
    """Words with a prefix, extra joints' mark in front."""
    return " ".join(
        word if word == "-" else ("~" if word[0] == "~" else "") + prefix + word.lstrip("~")
        for word in words.split()
    )


def _mixamo(prefix, fold=str):
    return _skeleton(
        lambda side, word: fold(prefix + side.title() + word),
        fold(_named(prefix, "Hips Spine Spine1 Spine2 Neck Head")),
        "Shoulder Arm ForeArm Hand",
        "UpLeg Leg Foot ToeBase",
        lambda joint: f"Hand{joint.title()}",
    )


def _letter(form):
    return lambda side, word: form.format(side=side[0], Side=side[0].upper(), word=word)


def _word(form):
    return lambda side, word: form.format(side=side, Side=side.title(), word=word)


def _biped_finger(joint):
    number, k = ("thumb", "index", "middle", "ring", "pinky").index(joint[:-1]), int(joint[-1])
    return f"Finger{number}" + ("" if k == 1 else str(k - 1))


def _unity_finger(joint):
    return joint[:-1].title() + ("Proximal", "Intermediate", "Distal")[int(joint[-1]) - 1]


SKELETONS = {
    "mixamo": _mixamo("mixamorig:"),
    "mixamo, underscore": _mixamo("mixamorig_"),
    "mixamo, nothing": _mixamo("mixamorig"),
    "mixamo, small letters": _mixamo("mixamorig", str.lower),
    "motionbuilder": _mixamo("Character1_"),
    "blender's mixamo": _mixamo("Armature|mixamorig:"),
    "any prefix": _mixamo("The-Man-2_"),
    "sketchfab": {
        joint: [f"{word}_{place:02}" for word in words]
        for place, (joint, words) in enumerate(_mixamo("mixamorig:").items())
    },
    "cmu": _skeleton(
        lambda side, word: (side[0].upper() if word == "HipJoint" else side.title()) + word,
        "Hips LowerBack Spine Spine1 Neck ~Neck1 Head", "Shoulder Arm ForeArm Hand ~FingerBase",
        "~HipJoint UpLeg Leg Foot ToeBase",
    ),
    "asf": _skeleton(
        _letter("{side}{word}"), "root lowerback upperback thorax lowerneck ~upperneck head",
        "clavicle humerus radius wrist ~hand ~fingers", "~hipjoint femur tibia foot toes",
    ),
    "poser": _skeleton(
        _letter("{side}{word}"), "hip abdomen chest - neck head", "Collar Shldr ForeArm Hand",
        "~Buttock Thigh Shin Foot Toe", lambda joint: joint.title().replace("Middle", "Mid"),
    ),
    "daz": _skeleton(
        _letter("{side}{word}"),
        "hip abdomenLower abdomenUpper ~chestLower chestUpper neckLower ~neckUpper head",
        "Collar ShldrBend ~ShldrTwist ForearmBend ~ForearmTwist Hand",
        "ThighBend ~ThighTwist Shin Foot ~Metatarsals Toe",
    ),
    "biped": _skeleton(
        _letter("Bip01 {Side} {word}"), _named("Bip01_", "Pelvis Spine Spine1 Spine2 Neck Head"),
        "Clavicle UpperArm Forearm Hand", "Thigh Calf Foot Toe0", _biped_finger,
    ),
    "biped, underscores": _skeleton(
        _letter("Bip001_{Side}_{word}"), _named("Bip001_", "Pelvis Spine Spine1 - Neck Head"),
        "Clavicle UpperArm Forearm Hand", "Thigh Calf Foot Toe0", _biped_finger,
    ),
    "unreal": _skeleton(
        _letter("{word}_{side}"),
        "pelvis spine_01 ~spine_02 spine_03 ~spine_04 spine_05 neck_01 ~neck_02 head",
        "clavicle upperarm ~upperarm_twist_01 lowerarm hand", "thigh calf foot ball",
        lambda joint: f"{joint[:-1]}_0{joint[-1]}",
    ),
    "blender": _skeleton(
        _letter("{word}.{Side}"), "hips spine chest - neck head", "shoulder upper_arm forearm hand",
        "thigh shin foot toe",
    ),
    "blender, underscore": _skeleton(
        _letter("{word}_{Side}"), "Hips Spine Chest - Neck Head", "Shoulder UpperArm LowerArm Hand",
        "UpperLeg LowerLeg Foot Toes",
    ),
    "rigify": _skeleton(
        _letter("DEF-{word}.{Side}"),
        _named("DEF-", "spine spine.001 spine.002 spine.003 spine.004 ~spine.005 spine.006"),
        "shoulder upper_arm forearm hand", "thigh shin foot toe",
        lambda joint: ("" if "thumb" in joint else "f_") + f"{joint[:-1]}.0{joint[-1]}",
    ),
    "makehuman": _skeleton(
        _letter("{word}.{Side}"), "root spine05 ~spine04 spine03 ~spine02 spine01 neck01 ~neck02 head",
        "clavicle ~shoulder01 upperarm01 ~upperarm02 lowerarm01 ~lowerarm02 wrist",
        "~pelvis upperleg01 ~upperleg02 lowerleg01 ~lowerleg02 foot -",
    ),
    "unity": _skeleton(
        _word("{Side}{word}"), "Hips Spine Chest UpperChest Neck Head", "Shoulder UpperArm LowerArm Hand",
        "UpperLeg LowerLeg Foot Toes", _unity_finger,
    ),
    "vroid": _skeleton(
        _letter("J_Bip_{Side}_{word}"), _named("J_Bip_C_", "Hips Spine Chest UpperChest Neck Head"),
        "Shoulder UpperArm LowerArm Hand", "UpperLeg LowerLeg Foot ToeBase", str.title,
    ),
    "xsens": _skeleton(
        _word("{Side}{word}"), "Hips Chest Chest2 ~Chest3 Chest4 Neck Head", "Collar Shoulder Elbow Wrist",
        "Hip Knee Ankle Toe",
    ),
    "xsens, segments": _skeleton(
        _word("{Side}{word}"), "Pelvis L5 L3 ~T12 T8 Neck Head", "Shoulder UpperArm ForeArm Hand",
        "UpperLeg LowerLeg Foot Toe",
    ),
    "low leg and low arm": _skeleton(
        _word("{Side}{word}"), "Hips - Chest - Neck Head", "Collar UpArm LowArm Hand", "UpLeg LowLeg Foot -"
    ),
    "smpl": _skeleton(
        _word("{Side}_{word}"), "Pelvis Spine1 Spine2 Spine3 Neck Head", "collar shoulder elbow wrist",
        "hip knee ankle foot", str,
    ),
    "smpl, letters": _skeleton(
        _letter("{Side}_{word}"), "Pelvis Spine1 Spine2 Spine3 Neck Head",
        "Collar Shoulder Elbow Wrist ~Hand",
        "Hip Knee Ankle Foot",
    ),
    "smpl, maya": _skeleton(
        _letter("m_avg_{Side}_{word}"), _named("m_avg_", "Pelvis Spine1 Spine2 Spine3 Neck Head"),
        "Collar Shoulder Elbow Wrist ~Hand", "Hip Knee Ankle Foot",
    ),
    "mujoco": _skeleton(
        _letter("{Side}_{word}"), "Pelvis Torso Spine Chest Neck Head",
        "Thorax Shoulder Elbow Wrist ~Hand",
        "Hip Knee Ankle Toe",
    ),
    "arkit": _skeleton(
        _word("{side}_{word}_joint"),
        "hips_joint spine_1_joint ~spine_2_joint ~spine_3_joint spine_4_joint ~spine_5_joint ~spine_6_joint "
        "spine_7_joint neck_1_joint ~neck_2_joint head_joint",
        "shoulder_1 arm forearm hand", "upLeg leg foot toes",
    ),
    "motive": _skeleton(
        _letter("{Side}{word}"), "Hip Ab Chest - Neck Head", "Shoulder UArm FArm Hand", "Thigh Shin Foot Toe"
    ),
    "second life": _skeleton(
        _word("m{word}{Side}"), "mPelvis mTorso mChest - mNeck mHead", "Collar Shoulder Elbow Wrist",
        "Hip Knee Ankle ~Foot Toe",
    ),
    "character creator": _skeleton(
        _letter("CC_Base_{Side}_{word}"), _named("CC_Base_", "Hip Waist Spine01 Spine02 NeckTwist01 Head"),
        "Clavicle Upperarm Forearm Hand", "Thigh Calf Foot ToeBase",
        lambda joint: joint.title().replace("Middle", "Mid"),
    ),
    "jnt": _skeleton(
        _letter("{Side}_{word}_JNT"),
        _named("C_", "Hips_JNT Spine_JNT Chest_JNT UpperChest_JNT Neck_JNT Head_JNT"),
        "Clavicle UpperArm Forearm Hand", "Thigh Shin Foot Toe",
    ),
    "names with spaces": _skeleton(
        _word("{Side} {word}"), "Hips Spine Spine_1 Spine_2 Neck Head", "Shoulder Arm Fore_Arm Hand",
        "Up_Leg Leg Foot Toe_Base",
    ),
    "no neck": _skeleton(
        _word("{Side}{word}"), "Hips Spine Spine1 Spine2 - Head", "Shoulder Arm ForeArm Hand",
        "UpLeg Leg Foot ToeBase",
    ),
    "no collars, no toes": _skeleton(
        _word("{Side}{word}"), "Hips Spine - - Neck Head", "- Shoulder Elbow Wrist", "Hip Knee Ankle -"
    ),
}  # fmt: skip
SKELETONS["names with spaces"] = {
    joint: [word.replace("_", " ") for word in words]
    for joint, words in SKELETONS["names with spaces"].items()
}
SKELETONS["biped"] = {
    joint: [word.replace("_", " ") for word in words] for joint, words in SKELETONS["biped"].items()
}


def told_by(skeleton):
    """The body's joints that a skeleton has."""
    return set(skeleton)


def extra_in(skeleton):
    """The names that a skeleton has besides."""
    return {word[1:] for words in skeleton.values() for word in words if word.startswith("~")}


def write_captured(
    path, rotation, way, person, skeleton, axes=None, order="ZXY", unit=100.0, frames=None, **more
):
    """The body's motion as a BVH file of a skeleton; joints that it lacks must not turn.

    Args:
        rotation, way: [T, 55, 3] rotation vectors and [T, 3] metres, Y up.
        axes: [3, 3], from the body's axes to the file's.
        order: of the angles.
        unit: of length, a metre.
        frames: joint -> [3, 3], the joint's own axes at zero rotation, by a function of the joint; the
            identity by default, which leaves the body in T pose where all angles are zero.
        more: ``ground``: metres that are added to the root's place; ``tilt`` [3, 3]: a turn of the whole
            world, skeleton left as it is; ``encoding``; ``rate``: the text of the frame time.
    """
    axes = torch.eye(3, dtype=torch.float64) if axes is None else axes
    tilt = more.get("tilt", torch.eye(3, dtype=torch.float64))
    own = frames or (lambda joint: torch.eye(3, dtype=torch.float64))
    rest, parents = unit * rest_joints(person.body, person.identity).double(), person.body.parents
    local = roma.rotvec_to_rotmat(rotation.double())
    lines, columns = ["HIERARCHY"], []
    root = unit * (way.double() + more.get("ground", torch.zeros(3, dtype=torch.float64)))

    def above(joint):
        joint = parents[joint]
        while joint >= 0 and JOINT_NAMES[joint] not in skeleton:
            joint = parents[joint]
        return joint

    def begin(name, offset, angles, deep):
        word = "JOINT" if deep else "ROOT"
        places = "" if deep else "Xposition Yposition Zposition "
        turns = " ".join(f"{letter}rotation" for letter in order)
        lines.append(f"{word} {name}\n{{ OFFSET {' '.join(f'{x:.8f}' for x in offset.tolist())}")
        lines.append(f"CHANNELS {3 if deep else 6} {places}{turns}")
        columns.append(angles)

    def add(joint, deep):
        parent, words = above(joint), skeleton[JOINT_NAMES[joint]]
        main = next(place for place, word in enumerate(words) if not word.startswith("~"))
        last = own(parent) if parent >= 0 else torch.eye(3, dtype=torch.float64)
        step = axes @ (rest[joint] - rest[parent]) if parent >= 0 else axes @ rest[joint]
        still = torch.eye(3, dtype=torch.float64).expand(len(way), 3, 3)
        for place, word in enumerate(words):
            offset = last.mT @ step if place == main else torch.zeros(3, dtype=torch.float64)
            turn = still
            if place == main:
                turn = last.mT @ axes @ local[:, joint] @ axes.mT @ own(joint)
                turn = tilt @ turn if parent < 0 else turn
                last = own(joint)
            begin(word.lstrip("~"), offset, turn, deep + place)
        below = [
            other for other, name in enumerate(JOINT_NAMES) if name in skeleton and above(other) == joint
        ]
        for other in below:
            add(other, deep + len(words))
        if not below:
            lines.append("End Site { OFFSET 0 1 0 }")
        lines.append("}" * len(words))

    add(0, 0)
    place = (root + rest[0]) @ (tilt @ axes).mT
    angles = [roma.rotmat_to_euler(order, turn, degrees=True) for turn in columns]
    lines += ["MOTION", f"Frames: {len(way)}", f"Frame Time: {more.get('rate', f'{1 / FPS:.8f}')}"]
    for row in range(len(way)):
        numbers = itertools.chain(place[row].tolist(), *(one[row].tolist() for one in angles))
        lines.append(" ".join(f"{number:.8f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n", encoding=more.get("encoding", "utf-8"))
    return path


def representable(rotation, skeleton):
    """The rotations with those joints still that a skeleton lacks."""
    known = [joint_index(name) for name in skeleton]
    still = torch.zeros_like(rotation)
    still[:, known] = rotation[:, known]
    return still


def random_frames(seed):
    """Axes of each joint's own, as exporters that follow the bones have them: joint -> [3, 3]."""
    rng = np.random.default_rng(seed)
    turns = roma.special_procrustes(torch.from_numpy(rng.normal(size=(len(JOINT_NAMES), 3, 3))))
    return lambda joint: turns[joint]
