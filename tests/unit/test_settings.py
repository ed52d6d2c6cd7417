from typing import Literal

import pytest
from pydantic import model_validator
from pydantic.dataclasses import dataclass

from pipeline.config.settings import (
    SETTINGS,
    Count,
    Iterations,
    Layer,
    Positive,
    as_dict,
    command_line_layer,
    help_lines,
    resolve,
    setting,
)  # fmt: skip
from pipeline.errors import UserError


@dataclass(frozen=True, config=SETTINGS)
class Train:
    iterations: Iterations = setting(10, "steps")
    rate: Positive = setting(1e-3, "of learning")
    gate: bool = setting(True, "leave out what is seen too seldom")
    name: str = setting("a", "whose")
    kind: Literal["own", "nearest"] = setting("own", "of weights")
    sizes: tuple[Count, ...] = setting((1, 2), "of pictures")
    frames: Count | None = setting(None, "how many; none: all")

    @model_validator(mode="after")
    def _fit_together(self):
        if self.frames and self.frames > self.iterations:
            raise ValueError(f"train.frames must be at most train.iterations, {self.iterations}")
        return self


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


def test_what_is_out_of_range_names_its_origin_though_a_stronger_layer_replaces_it():
    layers = [Layer("preset", {"train": {"rate": 0}}), command_line_layer({"train.rate": "1"})]
    with pytest.raises(UserError, match="preset: train.rate must be a number more than 0 .*, not 0"):
        resolve({"train": Train}, layers)


def test_fields_that_do_not_fit_each_other_are_checked_after_all_layers():
    layers = [Layer("preset", {"train": {"frames": 20}}), command_line_layer({"train.iterations": "30"})]
    assert resolve({"train": Train}, layers)["train"].frames == 20
    with pytest.raises(UserError, match="^preset: train.frames must be at most train.iterations, 10$"):
        resolve({"train": Train}, layers[:1])


def test_a_misspelt_word_shows_the_near_ones():
    with pytest.raises(UserError, match="one of own, nearest, not neares; did you mean nearest"):
        given(kind="neares")


def test_what_can_be_set_is_listed():
    lines = help_lines(Train, "train")
    assert lines[0] == "train.iterations=10: a whole number from 1 to 10000000; steps"
    assert lines[4] == "train.kind=own: one of own, nearest; of weights"


def test_unknown_names_show_the_near_ones():
    with pytest.raises(UserError, match="did you mean train.iterations"):
        given(iteration=3)
    with pytest.raises(UserError, match="did you mean train"):
        resolve({"train": Train}, [Layer("here", {"trian": {"rate": 1}})])


def test_settings_as_json_values():
    assert as_dict(Train())["sizes"] == [1, 2]
