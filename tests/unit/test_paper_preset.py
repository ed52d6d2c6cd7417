"""The paper preset: its weights against ExAvatar's, and all of its settings against docs/paper.md."""

import pytest

from pipeline.config.settings import read_toml
from pipeline.config.workspace import REPOSITORY
from stages.train.settings import TrainSettings
from tools.paper_settings import PAGE, ROW, resolved, written

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


def test_docs_paper_lists_every_setting_of_the_preset_with_a_reason_where_it_differs():
    """If this fails: python -m tools.paper_settings, and fill in the reasons."""
    page = PAGE.read_text(encoding="utf-8")
    assert page == written(page)
    quick, paper = resolved("quick"), resolved("paper")
    reasons = dict(ROW.findall(page))
    assert {name for name, reason in reasons.items() if reason.strip()} == {
        name for name in paper if paper[name] != quick[name]
    }


@pytest.fixture(scope="module")
def train():
    return TrainSettings(**read_toml(REPOSITORY / "data" / "presets" / "paper.toml")["train"])


def test_pictures_count_as_often_as_exavatar_compares_them(train):
    pictures = (OVER_SCENE, WITH_FACE, OVER_COLOR)
    total = {name: BRANCHES * sum(one.get(name, 0) for one in pictures) for name in OVER_SCENE}
    assert train.l1 * train.l1_renderings == pytest.approx(total["l1"])
    over_scene = BRANCHES * (OVER_SCENE["l1"] + WITH_FACE["l1"])
    assert train.scene_share == pytest.approx(over_scene / total["l1"], abs=1e-3)
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
