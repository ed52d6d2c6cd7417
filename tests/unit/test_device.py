"""The setting's word as a device, records that move, and the twins of the kernels that a GPU runs."""

import dataclasses
import importlib.util

import pytest
import torch
from torch import Tensor

from pipeline.avatar import Architecture, Avatar
from pipeline.avatar import head as heads
from pipeline.avatar.head import Head
from pipeline.avatar.skinning_tables import plain_normals, plain_place
from pipeline.body import Pose, joint_transforms, mean_identity
from pipeline.device import autocast, moved, product_dtype, resolve
from pipeline.errors import UserError
from tests.made.body import open_body
from tests.pretend_device import DEVICE, Elsewhere, pretend_device


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    ("word", "gpu", "gsplat", "device"),
    [
        ("cpu", True, True, "cpu"), ("cuda", True, True, "cuda"), ("cuda", True, False, "cuda"),
        ("auto", True, True, "cuda"), ("auto", True, False, "cpu"), ("auto", False, True, "cpu"),
    ],
)  # fmt: skip
def test_what_a_word_means(monkeypatch, word, gpu, gsplat, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if gsplat else None)
    assert resolve(word) == torch.device(device)


def test_cuda_without_a_gpu_names_the_remedy(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match=r"train\.device=cpu"):
        resolve("cuda")


@dataclasses.dataclass(frozen=True)
class Record:
    values: Tensor
    inner: tuple
    number: float
    nothing: None = None


def test_records_move_with_all_that_is_in_them():
    record = Record(drawn(3), (Record(drawn(2), (), 2.0), drawn(4)), 1.0)
    assert moved(record, "cpu") is record
    with pretend_device():
        there = moved(record, DEVICE)
        found = there.values, there.inner[0].values, there.inner[1]
        assert all(isinstance(one, Elsewhere) for one in found)
        assert (there.number, there.inner[0].number, there.nothing) == (1.0, 2.0, None)
        back = moved(there, "cpu")
    assert torch.equal(back.inner[0].values, record.inner[0].values)


@pytest.fixture(scope="module")
def avatar():
    body = open_body()
    sizes = Architecture(plane_resolution=4, plane_channels=2, width=16, subdivisions=0)
    return Avatar(body, mean_identity(body), torch.arange(len(body.v_template)), sizes)


def test_posing_in_plain_torch_is_that_of_the_kernels(avatar):
    canonical, rig = avatar.surface().canonical, avatar.surface().skinning_tables
    transforms = joint_transforms(0.4 * drawn(1, 55, 3), canonical.joints, canonical.parents)[0]
    points, transl = canonical.vertices + 0.0002 * drawn(len(canonical), 3, seed=1), drawn(3, seed=2)
    torch.testing.assert_close(
        rig.normals(transforms, points), plain_normals(rig, transforms, points), rtol=0, atol=2e-4
    )
    ours, plain = rig.place(transforms, points, transl), plain_place(rig, transforms, points, transl)
    torch.testing.assert_close(ours[0], plain[0], rtol=1e-5, atol=1e-5)
    # A quaternion and its negative are one orientation; where two entries tie, either may be taken.
    assert (ours[1] * plain[1]).sum(1).abs().min() > 1 - 1e-6


@pytest.mark.parametrize(("half", "tolerance"), [(False, 1e-4), (True, 0.05)])
def test_a_head_in_plain_torch_is_the_fused_one_with_gradients(monkeypatch, half, tolerance):
    head, results = Head(12, 3, condition=7, width=32, groups=4), []
    for number, parameter in enumerate(head.parameters()):
        parameter.data = 0.3 * drawn(*parameter.shape, seed=number)
    for serve in (True, False):
        monkeypatch.setattr(heads, "kernels_serve", lambda tensor, serve=serve: serve)
        head.zero_grad(set_to_none=True)
        points = drawn(50, 12, seed=40).requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            output = head(points, drawn(7, seed=41)).float()
        (output * drawn(50, 3, seed=42)).sum().backward()
        results.append([output.detach(), points.grad, *(one.grad for one in head.parameters())])
    for fused, plain in zip(*results, strict=True):
        assert (fused - plain).norm() <= tolerance * fused.norm()


def test_heads_are_multiplied_in_bfloat16_where_it_is_allowed_and_pays(monkeypatch):
    cpu = torch.device("cpu")
    for capability, dtype in (
        ("AVX512", torch.bfloat16),
        ("AVX2", torch.float32),
        ("DEFAULT", torch.float32),
    ):
        monkeypatch.setattr(
            torch.backends.cpu, "get_cpu_capability", lambda capability=capability: capability
        )
        assert product_dtype(cpu, True) == dtype and product_dtype(cpu, False) == torch.float32
        with autocast(cpu, True):
            assert torch.is_autocast_enabled("cpu") == (dtype == torch.bfloat16)
    assert product_dtype(torch.device("cuda"), True) == torch.bfloat16


def test_an_avatar_moves_there_and_back(avatar):
    pose = Pose(torch.zeros(55, 3), torch.zeros(5), torch.zeros(3))
    with torch.no_grad(), pretend_device():
        before = avatar.eval().gaussians(pose)
        there = avatar.to(DEVICE).gaussians(moved(pose, DEVICE))
        assert all(isinstance(one, Elsewhere) for one in there.tensors())
        after = avatar.to("cpu").gaussians(pose)
    for one, other in zip(before.tensors(), after.tensors(), strict=True):
        assert torch.equal(one, other)
