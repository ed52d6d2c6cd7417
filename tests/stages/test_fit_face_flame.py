"""Face first from FLAME: a head in its schema cut out of the open body (no FLAME is shipped)."""

import dataclasses
import json
import pickle
import sys
import types

import numpy as np
import pytest
import scipy.sparse
import torch

from pipeline.errors import UserError
from pipeline.numba_kernels import threads
from stages.fit.camera_batch import stack
from stages.fit.face import fit_face
from stages.fit.face.deca import FlameParameters, read_flame_parameters
from stages.fit.face.flame_model import load_flame
from stages.fit.face.from_flame import correspond, face_from_flame, transfer
from stages.fit.face.target import aligned, face_model
from stages.fit.observations import observe
from stages.fit.settings import FitSettings
from tests.made.detections import make_clip
from tests.made.faces import flame_arrays, write_deca
from tests.made.fake_body import Trap


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """As within ``fit_face``."""
    with threads(1):
        yield


@pytest.fixture(scope="module")
def face(model):
    return face_model(model[0], model[1].face_mesh)


@pytest.fixture(scope="module")
def arrays(model):
    return flame_arrays(model[0])


@pytest.fixture(scope="module")
def flame_file(arrays, tmp_path_factory):
    path = tmp_path_factory.mktemp("flame") / "flame.npz"
    np.savez(path, **arrays)
    return path


@pytest.fixture(scope="module")
def flame(flame_file):
    return load_flame(flame_file)


def parameters(count=3, shape=10, expressions=50):
    expression = torch.zeros(count, expressions)
    expression[1, 0], expression[1, 3] = 1.0, -0.5
    valid = torch.tensor([True, True, False])[:count]
    return FlameParameters(torch.zeros(shape), expression, torch.full((count, 3), 0.1), valid)


# The model file


def test_npz_and_pickle_give_the_same_model(arrays, flame, tmp_path, monkeypatch):
    class Ch:  # as chumpy pickles itself: a class of that name with its value as x
        __module__, __qualname__ = "chumpy.ch", "Ch"

        def __init__(self, x):
            self.x = x

    module = types.ModuleType("chumpy.ch")
    module.Ch = Ch
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    content = {
        "v_template": arrays["v_template"],
        "f": arrays["f"],
        "shapedirs": Ch(np.asfortranarray(arrays["shapedirs"])),
        "J_regressor": scipy.sparse.csc_matrix(arrays["J_regressor"]),
        "bs_type": "lrotmin",
        "names": np.array(["a", None], dtype=object),
    }
    for protocol in (2, 4, 5):
        path = tmp_path / f"flame{protocol}.pkl"
        path.write_bytes(pickle.dumps(content, protocol))
        monkeypatch.delitem(sys.modules, "chumpy.ch")  # reading needs no chumpy
        read = load_flame(path)
        monkeypatch.setitem(sys.modules, "chumpy.ch", module)
        for name in ("v_template", "faces", "shape_directions", "expression_directions", "joints"):
            assert torch.equal(getattr(read, name), getattr(flame, name)), (protocol, name)


class Evil:
    def __init__(self, call, *arguments):
        self.call, self.arguments = call, arguments

    def __reduce__(self):
        return self.call, self.arguments


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_malicious_pickle_is_refused_and_does_nothing(tmp_path, protocol):
    victim = tmp_path / "victim"
    for evil in (Trap(victim), Evil(exec, f"open({str(victim)!r}, 'w')"), Evil(getattr, "", "join")):
        path = tmp_path / "evil.pkl"
        path.write_bytes(pickle.dumps({"v_template": np.zeros((4, 3)), "weights": evil}, protocol))
        with pytest.raises(UserError, match="cannot be read as a FLAME model"):
            load_flame(path)
        assert not victim.exists()


def test_what_is_no_flame_model_is_said(arrays, tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        load_flame(tmp_path / "none.pkl")
    (tmp_path / "broken.pkl").write_bytes(b"\x80\x04nonsense")
    with pytest.raises(UserError, match="broken.pkl cannot be read"):
        load_flame(tmp_path / "broken.pkl")
    (tmp_path / "broken.npz").write_bytes(b"nonsense")
    with pytest.raises(UserError, match="broken.npz cannot be read"):
        load_flame(tmp_path / "broken.npz")
    for changes, message in (
        ({"J_regressor": None}, "no array 'J_regressor'"),
        ({"J_regressor": arrays["J_regressor"][:4]}, "other shapes"),
        ({"shapedirs": arrays["shapedirs"][..., :200]}, "other shapes"),
        ({"v_template": np.nan * arrays["v_template"]}, "not finite"),
    ):
        path = tmp_path / "bad.npz"
        np.savez(path, **{k: v for k, v in (arrays | changes).items() if v is not None})
        with pytest.raises(UserError, match=message):
            load_flame(path)


# What is made of it


def test_landmarks_find_themselves_on_the_same_head(model, face, flame):
    match = correspond(face, model[0], flame)
    assert match.kept.float().mean() > 0.98
    assert float(match.scale) == pytest.approx(1 / 0.9, rel=0.003)
    places = match.scale * match.of(flame.v_template) @ match.rotation.mT + match.shift
    assert (places - face.mean[match.kept]).norm(dim=1).mean() < 0.0003


def test_target_is_flames_face(model, face, flame):
    given = parameters()
    given.shape[0] = 2.0
    target = face_from_flame(face, model[0], flame, given)
    part = face.part(torch.isin(face.rows, target.rows))
    assert target.source == "flame" and target.orientation is None
    assert target.valid.tolist() == [True, True, False]
    assert torch.equal(target.jaw, torch.tensor([[0.1] * 3, [0.1] * 3, [0.0] * 3]))
    mean = face_from_flame(face, model[0], flame, parameters()).neutral
    assert (mean - part.mean).norm(dim=1).mean() < 0.0003
    assert (aligned(target.neutral, mean) - mean).norm(dim=1).mean() > 0.0001
    # Theirs is 0.8 of ours plus 0.3 of the next: known, but for the ridge.
    wanted = torch.zeros(target.expression.shape[1])
    wanted[0], wanted[1], wanted[3], wanted[4] = 0.8, 0.3, -0.4, -0.15
    moved = (part.expression @ (target.expression[1] - wanted)).norm(dim=1).mean()
    assert moved < 0.1 * (part.expression @ wanted).norm(dim=1).mean()
    assert (target.expression[[0, 2]] == 0).all()


def test_twin_bases_are_copied_and_others_are_not(face):
    expression = torch.randn(4, 12, generator=torch.Generator().manual_seed(0))
    same = transfer(face.expression, face.expression[..., :12], expression)
    assert torch.equal(same[:, :12], expression) and (same[:, 12:] == 0).all()
    swapped = transfer(face.expression, face.expression[..., :12].flip(2), expression)
    assert not torch.allclose(swapped[:, :12], expression, atol=0.5)


def test_sizes_that_disagree_are_said(model, face, flame):
    with pytest.raises(UserError, match="101 expressions"):
        face_from_flame(face, model[0], flame, parameters(expressions=101))
    none = parameters()
    none.valid[:] = False
    assert face_from_flame(face, model[0], flame, none) is None


def test_another_head_than_the_bodys_is_said(model, face, flame):
    ear = dataclasses.replace(flame, faces=flame.faces[:4])
    with pytest.raises(UserError, match="do not meet"):
        face_from_flame(face, model[0], ear, parameters())


# DECA's files


def test_parameters_are_read_by_frame(tmp_path):
    folder = write_deca(tmp_path / "flame_init", {3: True, 5: False, 9: True})
    read = read_flame_parameters(folder, np.array([3, 5, 7]))
    assert read.valid.tolist() == [True, False, False]
    assert read.shape.tolist() == [0.5] * 10
    assert read.expression.shape == (3, 50)
    assert read.expression[0].tolist() == pytest.approx([0.3] * 50) and (read.expression[1:] == 0).all()
    assert read.jaw[0].tolist() == pytest.approx([0.2, 0.0, 0.0]) and (read.jaw[1:] == 0).all()


def test_broken_parameters_are_said(tmp_path):
    with pytest.raises(UserError, match=r"shape_param\.json is missing"):
        read_flame_parameters(tmp_path, np.array([1]))
    folder = write_deca(tmp_path / "flame_init", {1: True})
    with pytest.raises(UserError, match="no file for any frame"):
        read_flame_parameters(folder, np.array([2]))
    for content in (
        "{",
        "[]",
        json.dumps({"expr": [1.0], "jaw_pose": [0.0]}),
        '{"expr": ["x"], "jaw_pose": 1}',
    ):
        (folder / "flame_params" / "1.json").write_text(content)
        with pytest.raises(UserError, match=r"1\.json"):
            read_flame_parameters(folder, np.array([1]))


def test_fit_face_from_flame(model, flame_file, tmp_path):
    clip = make_clip(*model, count=2)
    folder = write_deca(tmp_path / "flame_init", {frame: True for frame in clip.poses.frames})
    settings = FitSettings(face="flame", face_init=str(folder), flame_model=str(flame_file))
    said: list[str] = []
    observed = observe(clip.keypoints, model[1], 0.4, np.full((2, 2), 256.0))
    views = stack([clip.cameras[frame] for frame in clip.poses.frames])
    target = fit_face(*model, clip.keypoints, observed, views, settings, said.append)
    assert target.valid.all() and "(flame): fitted in 2 of 2 frames" in said[0]
