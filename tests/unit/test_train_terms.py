"""What the terms of the objective are built from: crops for LPIPS, the pasted face, weights by part."""

import dataclasses
from types import SimpleNamespace

import pytest
import torch

from pipeline.avatar import build_canonical
from pipeline.body import mean_identity
from pipeline.clip.camera import facing_camera
from pipeline.config.settings import Weight
from stages.train import STAGE, body_regions, losses, objective
from stages.train.face import Pasted, face_triangles, paste
from stages.train.losses import person_crop
from stages.train.settings import TrainSettings
from tests.made.body import open_body


@pytest.fixture(scope="module")
def canonical():
    body = open_body()
    return build_canonical(body, mean_identity(body), 0)


def a_mask() -> torch.Tensor:
    alpha = torch.zeros(40, 60)
    alpha[5:38, 2:20] = 1.0
    return alpha


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.999])
def test_crop_shows_the_person_and_stays_in_the_picture(share):
    rows, columns = person_crop(a_mask(), 16, share)
    assert (rows.stop - rows.start, columns.stop - columns.start) == (16, 16)
    assert 0 <= rows.start and rows.stop <= 40 and 0 <= columns.start and columns.stop <= 60
    assert a_mask()[rows, columns].sum() > 0


def test_crops_reach_all_of_the_person():
    covered = torch.zeros(40, 60, dtype=torch.bool)
    for share in torch.linspace(0, 0.999, 200).tolist():
        covered[person_crop(a_mask(), 8, share)] = True
    assert covered[a_mask() > 0.5].all() and not covered[:, 40:].any()


def test_crop_that_is_no_crop():
    assert person_crop(a_mask(), 0, 0.5) == (slice(0, 40), slice(0, 60))
    assert person_crop(a_mask(), 50, 0.5)[0] == slice(0, 40)
    rows, columns = person_crop(torch.zeros(40, 60), 16, 0.5)  # nobody
    assert (rows, columns) == (slice(12, 28), slice(22, 38))


CAMERA = facing_camera(24, 16, 20.0)
# Looking along -Z from the origin, at a square 1 m away that is larger than the picture.
SQUARE = torch.tensor([[-1.0, -1.0, -1.0], [1.0, -1.0, -1.0], [1.0, 1.0, -1.0], [-1.0, 1.0, -1.0]])
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])


def painted(vertices: torch.Tensor) -> torch.Tensor:
    """A colour that is linear in the place on the square."""
    return torch.cat(
        [0.5 + 0.3 * vertices[:, :1], 0.5 + 0.2 * vertices[:, 1:2], 0.1 + 0 * vertices[:, :1]], 1
    )


def test_pasted_mesh_shows_its_texture_and_feels_it_slide():
    vertices = SQUARE.clone().requires_grad_()
    pasted = paste(CAMERA, vertices, FACES, torch.tensor([True, True]), painted(SQUARE))
    assert len(pasted.rows) == 24 * 16
    across = (pasted.columns + 0.5 - 12) / 20
    torch.testing.assert_close(pasted.color[:, 0], 0.5 + 0.3 * across, rtol=0, atol=1e-5)
    # The square moved by 1 m to the right would show what lies 1 m further left.
    pasted.color[:, 0].sum().backward()
    assert float(vertices.grad[:, 0].sum()) == pytest.approx(-0.3 * 24 * 16, rel=1e-4)
    assert float(vertices.grad[:, 1].sum()) == pytest.approx(0, abs=1e-3)


def test_pasted_colour_is_perspective_correct_with_its_gradient():
    flat = torch.tensor([[-3.0, -2, -1], [3, -2, -1], [0, 5, -1]], dtype=torch.float64)
    slanted = flat * torch.tensor([[1.0], [3.0], [1.5]])
    camera = dataclasses.replace(
        CAMERA,
        intrinsics=CAMERA.intrinsics.double(),
        rotation=CAMERA.rotation.double(),
        translation=CAMERA.translation.double(),
    )
    faces, chosen, texture = torch.tensor([[0, 1, 2]]), torch.tensor([True]), painted(flat)
    pasted = paste(camera, slanted, faces, chosen, texture)
    assert len(pasted.rows) == 24 * 16
    # The ray of each pixel meets the triangle where corners^T b = t ray and the b sum to one.
    ray = torch.stack([(pasted.columns - 11.5) / 20, (7.5 - pasted.rows) / 20, -torch.ones(24 * 16)], 1)
    system = torch.zeros(24 * 16, 4, 4, dtype=torch.float64)
    system[:, :3, :3], system[:, :3, 3], system[:, 3, :3] = slanted.T, -ray, 1
    meets = torch.linalg.solve(system, torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(24 * 16, 4))
    torch.testing.assert_close(pasted.color, meets[:, :3] @ texture)

    def shown(vertices):
        return paste(camera, vertices, faces, chosen, texture).color

    assert torch.autograd.gradcheck(shown, slanted.requires_grad_())


def test_only_the_chosen_front_that_nothing_hides_is_pasted():
    both = torch.tensor([True, True])
    assert len(paste(CAMERA, SQUARE, FACES, ~both, painted(SQUARE)).rows) == 0
    assert len(paste(CAMERA, SQUARE, FACES.flip(1), both, painted(SQUARE)).rows) == 0
    half = len(paste(CAMERA, SQUARE, FACES, torch.tensor([True, False]), painted(SQUARE)).rows)
    assert 0 < half < 24 * 16
    vertices, faces = torch.cat([SQUARE, 0.5 * SQUARE]), torch.cat([FACES, FACES + 4])
    behind = torch.tensor([True, True, False, False])
    assert len(paste(CAMERA, vertices, faces, behind, painted(vertices)).rows) == 0


def test_face_loss_by_hand():
    rows, columns = torch.tensor([0, 1]), torch.tensor([1, 1])
    pasted = Pasted(rows, columns, torch.tensor([[0.5, 0.5, 0.5], [1.0, 0.0, 0.0]]))
    color, alpha = torch.full((2, 3, 3), 0.25), torch.ones(2, 3)

    def loss(pasted):
        term = next(term for term in objective.FRAME_TERMS if term.name == "face")
        frame = SimpleNamespace(face=pasted, view=SimpleNamespace(color=color, alpha=alpha))
        return float(losses.weighted_mean(term.loss(*term.of(frame)), term.mask(frame), term.count(frame)))

    assert loss(pasted) == pytest.approx((3 * 0.25 + 0.75 + 2 * 0.25) / 18)
    alpha[1, 1] = 0  # something else stands in front
    assert loss(pasted) == pytest.approx(3 * 0.25 / 18)
    assert loss(Pasted(rows[:0], columns[:0], torch.zeros(0, 3))) == 0


def test_face_triangles_are_those_of_the_face(canonical):
    chosen = face_triangles(canonical)
    assert 0.02 < float(chosen.float().mean()) < 0.5
    assert canonical.is_part("face")[canonical.faces[chosen]].all()


def test_weights_follow_the_parts(canonical):
    settings = TrainSettings(
        offset=1.0, offset_hands=2.0, offset_face=3.0, offset_scalp=5.0, laplacian_color_hands=4.0
    )
    terms = {term.name: term for term in objective.TERMS}
    weights = {
        name: body_regions.weight_by_part(canonical, *terms[name].part_weights(settings))
        for name in ("offset", "laplacian_color")
    }
    hands, face = canonical.is_part("left_hand", "right_hand"), canonical.is_part("face")
    assert set(weights["offset"][hands].flatten().tolist()) == {2.0}
    assert set(weights["offset"][face].flatten().tolist()) == {3.0}
    scalp = canonical.is_part("head")
    assert set(weights["offset"][scalp].flatten().tolist()) == {5.0}
    assert set(weights["offset"][~hands & ~face & ~scalp].flatten().tolist()) == {1.0}
    assert set(weights["laplacian_color"][hands].flatten().tolist()) == {4.0}
    assert body_regions.find_regions(canonical, {}, arms=False).undersides is None


def test_undersides_lie_below_what_they_are_paired_with(canonical):
    found = body_regions.find_undersides(canonical)
    matrix = found.above.matrix.to_dense()
    torch.testing.assert_close(matrix.sum(1), torch.ones(len(found.rows)))
    up = canonical.frames[:, 1, 2]
    assert (up[found.rows] < -0.5).all() and len(found.rows) > 50
    pairs = torch.nonzero(matrix)
    lower, upper = found.rows[pairs[:, 0]], pairs[:, 1]
    assert (up[upper] > 0.5).all()
    assert torch.equal(canonical.parts[lower], canonical.parts[upper])
    assert (canonical.vertices[lower, 0] - canonical.vertices[upper, 0]).abs().max() <= 0.01
    assert (matrix > 0).sum(1).max() <= 50


def test_lpips_is_asked_for_only_where_it_has_a_weight():
    assert STAGE.demands(TrainSettings(lpips=0.0)).assets == ()
    assert STAGE.demands(TrainSettings(lpips=0.2)).assets == ("lpips",)


def test_every_weight_of_the_settings_weighs_a_term():
    named = {name for term in objective.TERMS for name in (*term.weights, term.generated) if name}
    counts = {term.times for term in objective.TERMS if term.times}
    assert counts == {"l1_renderings", "renderings"}
    weights = {field.name for field in dataclasses.fields(TrainSettings) if field.type in ("Weight", Weight)}
    assert named == weights and len({term.name for term in objective.TERMS}) == len(objective.TERMS)


def test_terms_take_part_from_their_iteration_on_and_in_every_kth_draw():
    settings = TrainSettings(iterations=10, lpips=0.2, lpips_every=3, lpips_from=0.25, pose_heads_from=1.0)
    terms = {term.name: term for term in objective.TERMS}
    lpips = terms["lpips"]
    assert [lpips.takes_part(settings, 3, position, False) for position in range(4)] == [
        True,
        False,
        False,
        True,
    ]
    assert [lpips.takes_part(settings, iteration, 0, False) for iteration in (0, 2, 3)] == [
        False,
        False,
        True,
    ]
    assert lpips.scalar_weight(settings, False) == pytest.approx(0.6)
    assert lpips.scalar_weight(settings, True) == pytest.approx(3 * settings.generated)
    often = dataclasses.replace(settings, l1_renderings=6.5, renderings=2.0)
    assert [terms["l1"].scalar_weight(often, made) for made in (False, True)] == [0.8 * 6.5, 0.1 * 2]
    equal = dataclasses.replace(settings, generated_as_captured=True)
    assert [terms[name].scalar_weight(equal, True) for name in ("l1", "ssim")] == [0.8, 0.2]
    assert terms["pose_offset"].first_iteration(settings) is None  # 1 stands for never
    assert terms["hand_normal"].first_iteration(settings) is None  # no weight
    weighted = TrainSettings(face=0.8)
    assert [terms["face"].takes_part(weighted, 0, 0, generated) for generated in (False, True)] == [
        True,
        False,
    ]


def test_the_log_names_what_takes_part_with_its_weights():
    line = objective.describe_objective(TrainSettings(iterations=10, l1=0.7, pose_heads_from=0.35, lpips=0.0))
    assert "l1 0.7, ssim 0.2" in line and "pose_offset 50 from iteration 4" in line and "lpips" not in line
