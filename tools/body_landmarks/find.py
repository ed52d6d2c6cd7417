"""The four point sets of ``pipeline.body.landmarks`` on a body, found by its tree and its geometry."""

from __future__ import annotations

import numpy as np
import torch

from body_landmarks.face_registration import Surface, face_of, register
from body_landmarks.tables import (
    CONTOUR,
    IBUG_OF_FACE_MESH,
    IRIS_CENTRES,
    IRIS_DIRECTIONS,
    IRIS_RADIUS,
    PICKED,
)
from pipeline.body import BodyModel, Landmarks, PointSet, is_part, joint_index
from pipeline.body.landmarks import join

FINGERS = ("thumb", "index", "middle", "ring", "pinky")  # the estimators' order
SIDES = ("left", "right")


def find_landmarks(body: BodyModel, canonical: np.ndarray, ibug: np.ndarray | None) -> Landmarks:
    """All four sets.

    Args:
        body: the body.
        canonical: MediaPipe's canonical face, [468, 3]; X to the subject's left, Y up, Z front.
        ibug: the places of the 51 inner iBUG face points [51, 3] where the body's file has them.
            Without them it must be the open body, for which points were picked by hand.
    """
    finder = _Finder(body)
    face_mesh = finder.face_mesh(canonical, ibug)
    hands = join(*(finder.hand(side) for side in SIDES))
    whole_body = join(finder.coco_body(face_mesh), finder.feet(), face_mesh[list(IBUG_OF_FACE_MESH)], hands)
    return Landmarks(whole_body, finder.pose(face_mesh), hands, face_mesh)


class _Finder:
    """Places points on one body in T pose."""

    def __init__(self, body: BodyModel) -> None:
        self.body = body
        self.vertices = body.v_template.double().numpy()
        self.joints = (body.joint_regressor.double() @ body.v_template.double()).numpy()
        self.leading = body.skinning_weights.argmax(1).numpy()  # [V], the joint that each vertex follows

    def position(self, joint: str) -> np.ndarray:
        return self.joints[joint_index(joint)]

    def following(self, *joints: str) -> np.ndarray:
        """The vertices that follow one of the joints more than any other."""
        return np.flatnonzero(np.isin(self.leading, [joint_index(name) for name in joints]))

    def farthest(self, candidates: np.ndarray, direction: np.ndarray) -> int:
        """The vertex farthest along a direction."""
        return int(candidates[(self.vertices[candidates] @ direction).argmax()])

    def face_mesh(self, canonical: np.ndarray, ibug: np.ndarray | None) -> PointSet:
        """MediaPipe's 468 face points and two irises of five."""
        face = face_of(self.body)
        if ibug is None:
            seeds = self._picked(face.skin)
        else:
            seeds = dict(zip(IBUG_OF_FACE_MESH[CONTOUR:], ibug, strict=True))
        points = [_on_surface(*register(canonical, seeds, face))]
        for joint in IRIS_CENTRES.values():
            points.append(self._iris(joint))
        return join(*points)

    def _picked(self, skin: Surface) -> dict[int, np.ndarray]:
        """The hand-picked points at the front of the skin; the left ones are mirror images."""
        between = (self.position("left_eye") + self.position("right_eye")) / 2
        seeds = {}
        mirrored = {33: 263, 133: 362, 159: 386, 145: 374, 61: 291, 78: 308, 129: 358}
        for index, (right, up) in PICKED.items():
            place = between + np.array([-right, up, 0]) / 1e3
            place[2] = _front(skin, place[:2])
            seeds[index] = place
            if index in mirrored:
                seeds[mirrored[index]] = place * [-1, 1, 1]
        return seeds

    def _iris(self, joint: str) -> PointSet:
        """The pupil and the iris' four extreme points, on the eyeball."""
        follows = self.body.skinning_weights[:, joint_index(joint)].numpy() > 0.5
        faces = self.body.faces.numpy()
        eyeball = Surface(self.vertices, faces[follows[faces].all(1)])
        pupil = self.vertices[self.farthest(np.flatnonzero(follows), np.array([0, 0, 1]))]
        around = pupil + IRIS_RADIUS * np.pad(IRIS_DIRECTIONS, ((0, 0), (0, 1)))
        return _on_surface(*eyeball.closest(np.concatenate([pupil[None], around]))[:2])

    def hand(self, side: str) -> PointSet:
        """A hand's 21 points: wrist, then three joints and the tip of each finger."""
        points = [_joint(f"{side}_wrist")]
        for finger in FINGERS:
            last, before = f"{side}_{finger}3", f"{side}_{finger}2"
            tip = self.farthest(self.following(last), self.position(last) - self.position(before))
            points += [_joint(f"{side}_{finger}{k}") for k in (1, 2, 3)] + [_vertex(tip)]
        return join(*points)

    def toes(self, side: str) -> tuple[int, int, int]:
        """The tips of the big and of the small toe, and the heel."""
        candidates = self.following(f"{side}_ankle", f"{side}_foot")
        candidates = candidates[self.vertices[candidates, 1] < self.vertices[candidates, 1].min() + 0.05]
        outward = 1.0 if side == "left" else -1.0
        big = self.farthest(candidates, np.array([0, 0, 1]))
        small = self.farthest(candidates, np.array([outward, 0, 0.45]))
        return big, small, self.farthest(candidates, np.array([0, 0, -1]))

    def feet(self) -> PointSet:
        """COCO-WholeBody's six: big toe, small toe, heel, left then right."""
        return join(*(_vertex(vertex) for side in SIDES for vertex in self.toes(side)))

    def ear(self, side: str) -> int:
        """The front of the ear at its middle height, where estimators are taught to see the ear.

        The ear is what sticks out of the head: what lies within 12 mm of its widest.
        """
        outward = 1.0 if side == "left" else -1.0
        head = np.flatnonzero(is_part(self.body, "head", "face").numpy())
        across = self.vertices[head, 0] * outward
        ear = self.vertices[head[across > across.max() - 0.012]]
        foremost = np.quantile(ear[:, 2], 0.98)
        front = np.array([outward * (across.max() - 0.012), np.median(ear[:, 1]), foremost])
        return int(head[np.linalg.norm(self.vertices[head] - front, axis=1).argmin()])

    def coco_body(self, face_mesh: PointSet) -> PointSet:
        """COCO's 17: nose, eyes, ears, then shoulders to ankles, left before right."""
        head = [face_mesh[4:5], _joint("left_eye"), _joint("right_eye")]
        head += [_vertex(self.ear(side)) for side in SIDES]
        names = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        return join(*head, *(_joint(f"{side}_{name}") for name in names for side in SIDES))

    def pose(self, face_mesh: PointSet) -> PointSet:
        """MediaPipe's 33; its fingers are the knuckles of pinky and index and the thumb's second."""
        toes = {side: self.toes(side) for side in SIDES}
        points = [face_mesh[4:5]]
        for inner, eye, outer in ((362, "left_eye", 263), (133, "right_eye", 33)):
            points += [face_mesh[inner : inner + 1], _joint(eye), face_mesh[outer : outer + 1]]
        points += [_vertex(self.ear(side)) for side in SIDES]
        points += [face_mesh[291:292], face_mesh[61:62]]
        names = ("shoulder", "elbow", "wrist", "pinky1", "index1", "thumb3", "hip", "knee", "ankle")
        points += [_joint(f"{side}_{name}") for name in names for side in SIDES]
        points += [_vertex(toes[side][2]) for side in SIDES]
        points += [_vertex(toes[side][0]) for side in SIDES]
        return join(*points)


def _front(skin: Surface, place: np.ndarray) -> float:
    """The Z of the skin about an (x, y), seen from the front.

    Several rays within 1.5 mm are asked and a foremost one believed, for a single ray may pass
    between the closed lips and meet the throat.
    """
    steps = np.linspace(-0.0015, 0.0015, 5)
    depths = [_ray(skin, place + [dx, dy]) for dx in steps for dy in steps]
    return float(np.nanquantile(depths, 0.8))


def _ray(skin: Surface, place: np.ndarray) -> float:
    """The Z of the skin's foremost point at an (x, y); NaN if there is none."""
    corners = skin.vertices[skin.faces]
    a, b, c = (corners[:, k, :2] for k in range(3))
    area = _cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        opposite = [_cross(c - b, place - b), _cross(a - c, place - c), _cross(b - a, place - a)]
        shares = np.stack(opposite) / area
    inside = (shares >= 0).all(0) & (area != 0)
    if not inside.any():
        return float("nan")
    return float((shares.T[inside] * corners[inside, :, 2]).sum(1).max())


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _joint(name: str) -> PointSet:
    nowhere = torch.zeros(1, 3)
    return PointSet(torch.tensor([joint_index(name)]), nowhere.long(), nowhere)


def _vertex(index: int) -> PointSet:
    return PointSet(torch.tensor([-1]), torch.full((1, 3), index), torch.tensor([[1.0, 0, 0]]))


def _on_surface(triangles: np.ndarray, barycentrics: np.ndarray) -> PointSet:
    joint = torch.full((len(triangles),), -1)
    vertices = torch.from_numpy(triangles.astype(np.int64))
    return PointSet(joint, vertices, torch.from_numpy(barycentrics).float())
