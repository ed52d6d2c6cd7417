import dataclasses

import pytest

from pipeline.errors import UserError
from pipeline.settings import Layer, as_dict, command_line_layer, resolve


@dataclasses.dataclass(frozen=True)
class Train:
    iterations: int = 10
    rate: float = 1e-3
    gate: bool = True
    name: str = "a"
    sizes: tuple[int, ...] = (1, 2)
    frames: int | None = None


def given(**fields):
    return resolve({"train": Train}, [Layer("here", {"train": fields})])["train"]


def test_later_layers_win():
    layers = [
        Layer("one", {"train": {"iterations": 1, "rate": 2.0}}),
        command_line_layer({"train.iterations": "3"}),
    ]
    assert resolve({"train": Train}, layers)["train"] == Train(iterations=3, rate=2.0)


@pytest.mark.parametrize(
    ("field", "text", "value"),
    [
        ("iterations", "2e3", 2000),
        ("rate", "1e-4", 1e-4),
        ("gate", "off", False),
        ("gate", "TRUE", True),
        ("name", "x", "x"),
        ("sizes", "4,5,6", (4, 5, 6)),
        ("sizes", [7], (7,)),
        ("frames", "none", None),
        ("frames", "5", 5),
    ],
)
def test_text_is_read_as_the_field_s_type(field, text, value):
    read = getattr(given(**{field: text}), field)
    assert read == value and type(read) is type(value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("iterations", "1.5"),
        ("iterations", True),
        ("iterations", "x"),
        ("rate", "fast"),
        ("gate", 2),
        ("name", 3),
        ("sizes", "1,x"),
    ],
)
def test_what_does_not_fit_is_refused_and_names_its_origin(field, value):
    with pytest.raises(UserError, match=f"here: train.{field} must be"):
        given(**{field: value})


def test_unknown_names_show_the_near_ones():
    with pytest.raises(UserError, match="did you mean train.iterations"):
        given(iteration=3)
    with pytest.raises(UserError, match="did you mean train"):
        resolve({"train": Train}, [Layer("here", {"trian": {"rate": 1}})])


def test_settings_as_json_values():
    assert as_dict(Train())["sizes"] == [1, 2]
