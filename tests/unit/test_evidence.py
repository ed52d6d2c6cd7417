"""Evidence: what frames really showed of each Gaussian."""

from types import SimpleNamespace

import pytest
import torch

from pipeline.avatar.evidence import gather_evidence
from pipeline.clip.camera import facing_camera
from pipeline.clip.views import View
from pipeline.splat import Gaussians

SIZE = 48


def sheet(depth: float, side: int = 12, turned: bool = False):
    """A square of Gaussians half a metre wide that faces the camera, and its triangles."""
    line = torch.linspace(-0.25, 0.25, side)
    x, y = (one.flatten() for one in torch.meshgrid(line, line, indexing="xy"))
    points = torch.stack([x, y, torch.full_like(x, -depth)], 1)
    corner = (torch.arange(side - 1)[:, None] * side + torch.arange(side - 1)).flatten()
    right, up = corner + 1, corner + side
    faces = torch.cat([torch.stack([corner, right, up], 1), torch.stack([right, up + 1, up], 1)])
    return points, faces.flip(1) if turned else faces


def evidence_of(points, faces, alpha=1.0, spacing=0.5 / 11):
    count = len(points)
    gaussians = Gaussians(
        means=points,
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.full((count, 3), 0.6 * spacing),
        colors=torch.rand(count, 3),
        opacities=torch.full((count,), 0.999),
    )
    color = torch.tensor([0.2, 0.5, 0.8]).expand(SIZE, SIZE, 3)
    view = View(color, torch.full((SIZE, SIZE), alpha), facing_camera(SIZE, SIZE, 60.0))
    return gather_evidence([(gaussians, view)], SimpleNamespace(canonical=SimpleNamespace(faces=faces)))


def test_a_surface_before_the_camera_is_known_in_its_colour():
    found = evidence_of(*sheet(1.0))
    assert (found.trust == 1).all() and (found.shape_trust == 1).all()
    assert found.facing.min() > 0.9
    torch.testing.assert_close(found.color, torch.tensor([0.2, 0.5, 0.8]).expand(144, 3), atol=1e-3, rtol=0)


def test_what_lies_behind_another_surface_is_not_known():
    (front, faces), (behind, _) = sheet(1.0), sheet(1.05)
    inner = (behind[:, :2].abs() < 0.24).all(1)  # the pieces along the border are halves
    behind = behind * torch.tensor([0.8, 0.8, 1])
    found = evidence_of(torch.cat([front, behind]), torch.cat([faces, faces + 144]))
    hidden = found.trust[144:][inner]
    assert (found.trust[:144] == 1).all() and hidden.mean() < 0.02 and hidden.max() < 0.5


def test_what_faces_away_keeps_its_colour_and_tells_no_other():
    found = evidence_of(*sheet(1.0, turned=True))
    assert (found.source == 0).all() and (found.trust == 1).all() and (found.shape_trust == 1).all()


def test_evidence_does_not_depend_on_how_finely_the_surface_is_divided():
    coarse, fine = evidence_of(*sheet(1.0)), evidence_of(*sheet(1.0, side=34), spacing=0.5 / 33)
    assert (coarse.trust == 1).all() and (fine.trust == 1).float().mean() > 0.95


def test_where_the_mask_is_zero_a_place_is_known_and_no_colour():
    found = evidence_of(*sheet(1.0), alpha=0.0)
    assert (found.trust == 0).all() and (found.shape_trust == 1).all() and found.color.isfinite().all()


def test_other_frames_fill_what_these_do_not_show():
    shown, hidden = evidence_of(*sheet(1.0)), evidence_of(*sheet(1.0), alpha=0.0)
    torch.testing.assert_close(hidden.filled(shown).color, shown.color)
    torch.testing.assert_close(shown.filled(hidden).trust, shown.trust)


def test_what_shows_between_others_keeps_its_colour_and_tells_none():
    shown, hidden = evidence_of(*sheet(1.0)), evidence_of(*sheet(1.0), alpha=0.0)
    kept = hidden.with_colors_of(shown)
    assert (kept.trust == 1).all() and (kept.source == 0).all()
    torch.testing.assert_close(kept.color, shown.color)


def test_a_vertex_a_hair_behind_those_around_it_is_seen_with_them():
    points, faces = sheet(1.0)
    points[66, 2] -= 0.03
    assert evidence_of(points, faces).trust[66] == 1


def test_without_frames_there_is_no_evidence():
    with pytest.raises(ValueError, match="frame"):
        gather_evidence([], SimpleNamespace(canonical=SimpleNamespace(faces=None)))
