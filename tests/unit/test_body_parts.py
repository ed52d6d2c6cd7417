"""Part labels: they cover the body, and left mirrors right."""

import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from pipeline.body import PARTS, is_face, is_part, part_labels
from pipeline.body.parts import joint_parts


def test_every_vertex_has_a_part_and_every_part_has_vertices(body):
    labels = part_labels(body)
    assert labels.shape == (len(body.v_template),) and labels.dtype == torch.int8
    counts = torch.bincount(labels.long(), minlength=len(PARTS))
    assert len(counts) == len(PARTS) and (counts > 300).all(), dict(zip(PARTS, counts.tolist(), strict=True))


def test_left_mirrors_right(body):
    labels = part_labels(body).long()
    swapped = [name.replace("left", "?").replace("right", "left").replace("?", "right") for name in PARTS]
    mirror_label = torch.tensor([PARTS.index(name) for name in swapped])
    vertices = body.v_template.numpy()
    mirror = torch.from_numpy(cKDTree(vertices).query(vertices * [-1, 1, 1])[1])
    assert (mirror_label[labels] != labels[mirror]).float().mean() < 2e-3, "but for ties on the midline"


def test_parts_lie_where_their_names_say(body):
    x, y, z = body.v_template.unbind(1)
    assert (x[is_part(body, "left_hand")] > 0.6).all() and (x[is_part(body, "right_hand")] < -0.6).all()
    assert y[is_part(body, "left_leg", "right_leg")].max() < y[is_part(body, "head", "face")].min()
    face = is_part(body, "face")
    assert (is_face(body)[face]).all()
    eyes = body.skinning_weights[:, 23:25].sum(1) > 0.9
    assert face[eyes].all() and z[face].mean() > z[is_part(body, "head")].mean() + 0.05


def test_parts_hang_together(body):
    labels = part_labels(body)
    for index, name in enumerate(PARTS):
        faces = body.faces[(labels[body.faces] == index).all(1)].numpy()
        pieces = trimesh.graph.connected_components(faces[:, [0, 1, 1, 2]].reshape(-1, 2))
        largest = max(len(piece) for piece in pieces) / sum(len(piece) for piece in pieces)
        # but for eyeballs, and the throat's end of the mouth, which is the head's
        assert largest > (0.92 if name in ("face", "head") else 0.999), name


def test_joints_have_parts():
    assert joint_parts().shape == (55,)
    assert PARTS[joint_parts()[20]] == "left_hand" and PARTS[joint_parts()[22]] == "head"


def test_an_unknown_part_is_an_error(body):
    with pytest.raises(ValueError):
        is_part(body, "tail")
