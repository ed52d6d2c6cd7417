"""plan.json: what was decided comes back as it was written, and nothing else is taken for a plan."""

import dataclasses
import json

import pytest

from pipeline.clip.plan import EFFECTS, Decision, Plan, read_plan, write_plan
from pipeline.errors import UserError


def made_plan(**changes) -> Plan:
    decisions = [
        Decision(name, on=place % 2 == 0, measured=0.25 * place, threshold=1, unit="px", why="because")
        for place, name in enumerate(EFFECTS)
    ]
    return Plan(tuple(dataclasses.replace(one, **changes.get(one.effect, {})) for one in decisions))


def test_plan_comes_back(tmp_path):
    plan = made_plan(auxiliary_views={"values": (90.0, 180.0), "forced": True})
    write_plan(tmp_path / "plan.json", plan)
    read = read_plan(tmp_path / "plan.json")
    assert {one.effect: one for one in read.decisions} == {one.effect: one for one in plan.decisions}
    assert read["auxiliary_views"].values == (90.0, 180.0)
    assert read.on(EFFECTS[0]) and not read.on(EFFECTS[1])
    with pytest.raises(KeyError):
        read["no such effect"]


def test_order_of_decisions_does_not_change_the_file(tmp_path):
    plan = made_plan()
    write_plan(tmp_path / "a.json", plan)
    write_plan(tmp_path / "b.json", Plan(plan.decisions[::-1]))
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows.pop(), "has not"),
        (lambda rows: rows.append(rows[0]), "has not"),
        (lambda rows: rows[0].update(effect="cooking"), "no effect 'cooking'"),
        (lambda rows: rows[0].update(on="yes"), "true or false"),
        (lambda rows: rows[0].update(measured=None), "must be numbers"),
        (lambda rows: rows[0].update(values=[True]), "must be numbers"),
        (lambda rows: rows[0].update(why=3), "must be text"),
        (lambda rows: rows[0].pop("unit"), "the fields"),
        (lambda rows: rows[0].update(more=1), "the fields"),
    ],
)
def test_malformed_plan_names_the_file_and_the_remedy(tmp_path, change, message):
    path = tmp_path / "plan.json"
    write_plan(path, made_plan())
    content = json.loads(path.read_text())
    change(content["decisions"])
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=message) as caught:
        read_plan(path)
    assert str(path) in str(caught.value) and "plan stage" in str(caught.value)


@pytest.mark.parametrize("text", ["[]", "{}", '{"decisions": 3}', '{"decisions": [], "more": 1}', "{"])
def test_what_is_no_plan_is_refused(tmp_path, text):
    (tmp_path / "plan.json").write_text(text)
    with pytest.raises(UserError, match=r"plan\.json"):
        read_plan(tmp_path / "plan.json")


def test_numbers_must_be_finite():
    with pytest.raises(ValueError, match="finite"):
        Decision(EFFECTS[0], True, float("nan"), 0, "", "")
