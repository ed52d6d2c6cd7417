"""The paper preset: its weights against ExAvatar's."""

import pytest

from pipeline.config.settings import read_toml
from pipeline.config.workspace import REPOSITORY
from stages.train.settings import TrainSettings

# ExAvatar's weights: of one branch's pictures, and of regularisers with the number of branches they take.
OVER_SCENE, WITH_FACE, OVER_COLOR = {"l1": 0.8, "ssim": 0.2, "lpips": 0.2}, {"l1": 0.8}, {"l1": 1.0}
FACE = 0.8
BRANCHES = 2
REGULARISERS = {  # name: (body, hands, face, scalp) in ExAvatar's units, rows there, rows here
    "offset": ((10, 1000, 10, 1), 1, 1),
    "laplacian_offset": ((1e5, 1e5, 50e5, 1e5), 2, 2),  # of dV, and of dV + dV_pose
    "laplacian_scale": ((1e5 * 10, 1e5 * 10, 0, 1e5 * 10), 2, 1),
    "laplacian_color": ((0.1, 100, 0.1, 0.1), 2, 1),
    "scale_size": ((1, 1000, 10, 1), 1, 1),
    "pose_scale": ((1, 1000, 10, 1), 1, 1),
    "pose_offset": ((10, 10, 10, 10), 1, 1),  # 0 on hands and face
}


@pytest.fixture(scope="module")
def train():
    return TrainSettings(**read_toml(REPOSITORY / "data" / "presets" / "paper.toml")["train"])


def test_pictures_count_as_often_as_exavatar_compares_them(train):
    pictures = (OVER_SCENE, WITH_FACE, OVER_COLOR)
    total = {name: BRANCHES * sum(one.get(name, 0) for one in pictures) for name in OVER_SCENE}
    assert train.l1 * train.l1_renderings == pytest.approx(total["l1"])
    assert train.ssim * train.renderings == pytest.approx(total["ssim"])
    assert train.lpips * train.renderings == pytest.approx(total["lpips"])
    assert train.face * train.renderings == pytest.approx(BRANCHES * FACE)


@pytest.mark.parametrize("name", REGULARISERS)
def test_regularisers_weigh_as_in_exavatar(train, name):
    weights, rows_there, rows_here = REGULARISERS[name]
    body = getattr(train, name)
    for part, weight in zip(("", "_hands", "_face", "_scalp"), weights, strict=True):
        here = getattr(train, name + part, body)
        assert rows_here * here == pytest.approx(rows_there * weight), name + part
    assert train.scale_smoothness == "metres"  # as ExAvatar's Laplacian of scales
