"""The objective on the tiny synthetic subject: which term moves what, and how draws add up."""

import dataclasses

import pytest
import torch
from torch import nn

from pipeline.avatar import Avatar
from pipeline.clip.records import Split
from pipeline.clip.views import ViewCache
from stages.train.data import TrainingData
from stages.train.initial_avatar import initial_avatar
from stages.train.objective import TrainingObjective
from stages.train.poses import PoseRefinement
from stages.train.scene import read_scene
from stages.train.settings import TrainSettings
from tests.made.portrait import context_for, data_for

ALL_ON = {
    "pose_noise": 0.0, "pose_heads_from": 0.0, "residual_from": 0.0, "refine_from": 0.0,
    "half_precision": False,
}  # fmt: skip


class Brightness(nn.Module):
    """Stands for LPIPS: the difference of mean brightness, in float64 as it is far smaller than either."""

    def forward(self, image, target):
        return (image.double().mean() - target.double().mean()).abs()[None].float()


@dataclasses.dataclass(frozen=True)
class SaidToBeGenerated:
    """Captured frames that pass for generated ones."""

    captured: ViewCache
    frames: tuple[int, ...]

    def view(self, frame):
        return dataclasses.replace(self.captured[frame], generated=True)


@dataclasses.dataclass(frozen=True)
class Scene:
    """An awakened avatar, every part of it active, and what it is compared with."""

    settings: TrainSettings
    avatar: Avatar
    poses: PoseRefinement
    data: TrainingData

    def objective(self, generated=(), **changes) -> TrainingObjective:
        learnt, data = self.data.clip.split.train, self.data
        made = SaidToBeGenerated(data.crops, tuple(frame for frame in learnt if frame in generated))
        captured = Split(tuple(frame for frame in learnt if frame not in generated), ())
        clip = dataclasses.replace(data.clip, split=captured)
        settings = dataclasses.replace(self.settings, **changes)
        data = dataclasses.replace(data, clip=clip, generated=made)
        return TrainingObjective(self.avatar, self.poses, data, settings, Brightness())


def scene(subject, output, **changes) -> Scene:
    context = context_for(subject, output, **{**ALL_ON, **changes})
    data = data_for(context)
    refinement = PoseRefinement(data.poses, data.clip.split.train)
    avatar, data = initial_avatar(data, refinement, context.settings)
    avatar.pose_heads_active = avatar.residuals_active = True
    generator = torch.Generator().manual_seed(5)
    for parameter in avatar.parameters():
        parameter.data += 0.02 * torch.randn(parameter.shape, generator=generator)
    return Scene(context.settings, avatar, refinement, data)


@pytest.fixture(scope="module")
def objective(subject, tmp_path_factory):
    """Makes objectives over one avatar; ``changes`` are settings of the objective."""
    return scene(subject, tmp_path_factory.mktemp("gated") / "out").objective


def gradients(objective: TrainingObjective, iterations: range, only: str = "") -> dict[str, torch.Tensor]:
    """The gradient of each parameter, summed over some iterations at the same weights."""
    modules = {"avatar": objective.avatar, "poses": objective.poses}
    for module in modules.values():
        module.zero_grad(set_to_none=True)
    for iteration in iterations:
        terms = objective(iteration, 0, True)
        chosen = [value for name, value in terms.items() if not only or name == only]
        torch.stack(chosen).sum().backward()
    return {
        f"{prefix}.{name}": torch.zeros_like(parameter) if parameter.grad is None else parameter.grad.clone()
        for prefix, module in modules.items()
        for name, parameter in module.named_parameters()
    }


def test_double_batch_equals_two_accumulated_steps(objective):
    single, double = (
        objective(batch=1, lpips=0.2, lpips_every=3),
        objective(batch=2, lpips=0.2, lpips_every=3),
    )
    one_by_one, together = gradients(single, range(2, 4)), gradients(double, range(1, 2))
    for name, gradient in one_by_one.items():
        torch.testing.assert_close(gradient / 2, together[name], rtol=1e-3, atol=1e-6, msg=name)


def test_face_term_moves_geometry_and_poses_and_never_colours(objective):
    found = gradients(objective(), range(1), "face").items()
    moved = {name.removeprefix("avatar.representation.") for name, one in found if bool((one != 0).any())}
    frame = objective().draw(0).frame
    assert {"triplane.planes", "geometry.last.weight", f"poses.rotation.{frame}"} <= moved
    assert f"poses.transl.{frame}" in moved and f"poses.expression.{frame}" in moved
    assert not any(name.startswith(("color", "pose_color", "residuals")) for name in moved)
    assert not any(name.startswith("poses.") and not name.endswith(f".{frame}") for name in moved)


def test_pictures_reach_every_head(objective):
    still = {
        name
        for name, one in gradients(objective(pose_change=1.0), range(3)).items()
        if not bool((one != 0).any()) and name.startswith("avatar.")
    }
    assert not still


def test_lpips_of_every_kth_draw_has_k_times_the_weight(objective):
    whole = {"lpips": 0.2, "pose_seen_only": False}  # else a frame's second draw differs from its first
    every, third = objective(lpips_every=1, **whole), objective(lpips_every=3, **whole)
    assert ["lpips" in third(iteration, 0, False) for iteration in range(4)] == [True, False, False, True]
    for position in (0, 3):
        one, other = (float(each(position, 0, False)["lpips"].detach()) for each in (every, third))
        assert one > 0 and other == pytest.approx(3 * one)


def test_second_draw_of_a_frame_poses_what_the_first_one_showed(objective):
    made, whole = objective(face=0.0, pose_seen_only=True), objective(face=0.0, pose_seen_only=False)
    frame, count = made.draw(0).frame, len(made.avatar)
    assert made.visibility_cache.visible_rows(frame, 0, count) is None  # and so the first draw poses all
    first, expected = (terms(0, 0, False) for terms in (made, whole))
    assert all(torch.equal(first[name], expected[name]) for name in expected)
    rows = made.visibility_cache.visible_rows(frame, 0, count)
    assert 0 < len(rows) < count
    assert made.visibility_cache.visible_rows(frame, 1, count) is None  # another level has other Gaussians
    again = made(0, 0, False)
    torch.testing.assert_close(again["l1"], expected["l1"], rtol=1e-3, atol=1e-6)
    assert 0 < again["pose_offset"] < expected["pose_offset"]  # hidden ones are not asked for
    assert torch.equal(whole(0, 0, False)["pose_offset"], expected["pose_offset"])


def test_what_was_left_out_by_mistake_is_posed_again_at_the_next_draw(objective):
    made = objective(pose_seen_only=True)
    frame, count = made.draw(0).frame, len(made.avatar)
    made(0, 0, False)
    right = made.visibility_cache.visible_rows(frame, 0, count)
    made.visibility_cache.record(frame, 0, torch.zeros(count))
    assert len(made.visibility_cache.visible_rows(frame, 0, count)) == 0
    assert all(bool(term.isfinite()) for term in made(0, 0, False).values())
    found = made.visibility_cache.visible_rows(frame, 0, count)
    assert len(set(found.tolist()) ^ set(right.tolist())) < 0.1 * len(right)


def test_residual_heads_are_sometimes_told_no_time(objective):
    made = objective(time_dropout=0.25)
    times = [made.draw(position).time for position in range(400)]
    assert 60 < sum(time is None for time in times) < 140
    assert {time for time in times if time is not None} == {made.data.clip.seconds[f] for f in range(5)}
    always = objective(time_dropout=0.0)
    assert all(always.draw(position).time is not None for position in range(50))


def test_generated_frames_weigh_less_and_have_no_face(objective):
    captured, made = objective(), objective(generated=range(6))
    with torch.no_grad():
        real, copied = captured(0, 0, False), made(0, 0, False)
    assert float(copied["l1"]) == pytest.approx(float(real["l1"]) * 0.1 / 0.8)
    assert float(copied["ssim"]) == pytest.approx(float(real["ssim"]) * 0.1 / 0.2)
    assert "face" in real and "face" not in copied
    assert float(copied["laplacian_offset"]) == float(real["laplacian_offset"])


@pytest.mark.parametrize("every", [2, 5])
def test_one_draw_in_so_many_is_of_a_generated_frame(objective, every):
    made = objective(generated=(2,), generated_every=every)
    frames = [made.draw(position).frame for position in range(40 * every)]
    blocks = [frames[start : start + every] for start in range(0, len(frames), every)]
    assert all(block.count(2) == 1 for block in blocks)
    assert 1 < sum(block[0] == 2 for block in blocks) < 39  # in no fixed order
    captured = [frame for frame in frames if frame != 2]
    assert all(captured.count(frame) == 10 * (every - 1) for frame in (0, 1, 3, 4))


def test_lpips_begins_when_it_is_told_to(objective):
    late = objective(lpips=0.2, lpips_every=1, lpips_from=0.5)  # of 12 iterations
    assert ["lpips" in late(iteration, 0, False) for iteration in (5, 6, 11)] == [False, True, True]


def test_regularisers_with_a_weight_appear_and_others_cost_nothing(subject, tmp_path):
    whole = scene(subject, tmp_path / "whole", gate=False).objective
    optional = {"hand_normal", "scale_size", "pose_scale", "scale_growth", "hand_color", "arm_color"}
    none = whole(scale_growth=0.0)(0, 0, False)
    every = whole(**dict.fromkeys(optional, 1.0))(0, 0, False)
    assert not optional & set(none) and optional <= set(every)
    assert all(float(every[name].detach()) > 0 for name in optional)


def test_term_that_lacks_what_it_needs_is_refused(objective):
    made = objective()
    bare = dataclasses.replace(made.data, texture=None)
    with pytest.raises(ValueError, match="texture"):
        TrainingObjective(made.avatar, made.poses, bare, made.settings)
    with pytest.raises(ValueError, match="LPIPS"):
        TrainingObjective(made.avatar, made.poses, made.data, dataclasses.replace(made.settings, lpips=0.2))


def test_the_whole_frame_is_compared_over_the_clips_own_background(subject, tmp_path):
    made = scene(subject, tmp_path / "scene", gate=False)
    clip, box, said = made.data.clip, made.data.crops.box, []
    behind = read_scene(clip, box, said.append)
    assert "%" in said.pop()
    view = made.data.view(0)
    assert behind.color.shape == view.color.shape and behind.confidence.shape == view.alpha.shape
    known = (behind.confidence > 0) & (view.alpha == 0)
    torch.testing.assert_close(behind.color[known], view.color[known], rtol=0, atol=0.03)
    plain = made.objective()(0, 0, False)
    over = dataclasses.replace(made, data=dataclasses.replace(made.data, scene=behind))
    mixed = over.objective(scene_share=0.25)(0, 0, False)
    assert "l1_scene" not in plain and "l1_scene" not in over.objective()(0, 0, False)
    assert float(mixed["l1"].detach()) == pytest.approx(0.75 * float(plain["l1"].detach()), rel=1e-5)
    assert 0 < float(mixed["l1_scene"].detach()) < 0.1
    assert not {"l1_scene"} & set(over.objective(scene_share=0.25, generated=(0, 1, 2, 3, 4))(0, 0, False))
    moved = dict(clip.cameras)
    moved[1] = dataclasses.replace(moved[1], translation=moved[1].translation + 0.1)
    few = Split(clip.split.train[:2], clip.split.test)
    for changed in ({"cameras": moved}, {"split": few}):  # of two frames nothing is known behind the person
        assert read_scene(dataclasses.replace(clip, **changed), box, said.append) is None
        assert "train.scene_share does nothing" in said.pop() and not said
