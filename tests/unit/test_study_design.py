"""Frontiers, and which points a study makes within its budget."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.studies.design import (
    Design,
    Made,
    area,
    base_of,
    label_of,
    next_combination,
    next_single,
    singles,
    words_of,
)
from pipeline.studies.frontier import frontier, short_of
from pipeline.studies.knobs import Knob, Level

NUMBERS = st.floats(-100, 100) | st.just(math.nan)
POINTS = st.lists(st.tuples(st.floats(0.1, 100) | st.just(math.nan), NUMBERS), max_size=30)


def dominates(one, other):
    return one[0] <= other[0] and one[1] >= other[1] and one != other


@given(POINTS)
def test_a_frontier_is_what_nothing_dominates(points):
    kept = frontier([cost for cost, _ in points], [quality for _, quality in points])
    known = [point for point in points if not any(map(math.isnan, point))]
    chosen = [points[place] for place in kept]
    assert set(chosen) == {one for one in known if not any(dominates(other, one) for other in known)}
    assert len(set(chosen)) == len(chosen)
    assert all(a[0] < b[0] and a[1] < b[1] for a, b in zip(chosen, chosen[1:], strict=False))


@given(POINTS, st.randoms())
def test_a_frontier_does_not_hang_on_the_order_and_is_its_own(points, random):
    def of(some):
        return [some[place] for place in frontier([c for c, _ in some], [q for _, q in some])]

    shuffled = points[:]
    random.shuffle(shuffled)
    assert of(points) == of(shuffled) == of(of(points))


@given(POINTS)
def test_what_lies_on_the_frontier_lacks_nothing_and_all_else_something(points):
    costs, qualities = [c for c, _ in points], [q for _, q in points]
    kept = set(frontier(costs, qualities))
    for place, (cost, quality) in enumerate(points):
        if not math.isnan(cost) and not math.isnan(quality):
            lacks = short_of(cost, quality, costs, qualities)
            assert lacks >= 0
            if place in kept:
                assert lacks == 0


@given(POINTS, st.tuples(st.floats(0.1, 100), st.floats(-100, 100)))
def test_area_only_grows_and_only_by_what_pushes_the_frontier_out(points, further):
    known = [point for point in points if not any(map(math.isnan, point))]
    corner = (200.0, -100.0)
    before, after = area(known, corner), area([*known, further], corner)
    assert after >= before - 1e-9
    if any(dominates(one, further) or one == further for one in known):
        assert after == pytest.approx(before)


KNOBS = (
    Knob("iterations", (Level("100"), Level("50", {"a": "50"}, 0.5), Level("200", {"a": "200"}, 2.0))),
    Knob("size", (Level("small"), Level("large", {"b": "large"}, 3.0))),
    Knob("effect", (Level("with"), Level("without", {"c": "off"}, 0.9))),
    Knob("chance", (Level("seed 0"), Level("seed 1", {"d": "1"})), combines=False),
)
STAGES = ("fit", "train")


class World:
    """Where costs multiply and gains add up, as the design believes, or not quite."""

    def __init__(self, factors, gains, surprise=0.0):
        self.factors, self.gains, self.surprise = factors, gains, surprise
        self.made, self.stored, self.spent = [], set(), 0.0

    def seconds(self, point):
        train = 100.0
        for place, level in enumerate(point):
            train *= self.factors[place][level]
        return {"fit": 10.0, "train": train * (1 + self.surprise * (sum(point) % 3 - 1))}

    def needed(self, point):
        return () if point in self.stored else ("train",) if self.made else STAGES

    def make(self, point):
        assert point not in [one.point for one in self.made]
        took = self.seconds(point)
        if point not in self.stored:
            self.spent += sum(took[stage] for stage in (("train",) if self.made else STAGES))
        quality = 30 + sum(gain[level] for gain, level in zip(self.gains, point, strict=True))
        self.made.append(Made(point, took, took["train"], quality))
        self.stored.add(point)

    def run(self, budget, most=200):
        for choose in (next_single, next_combination):
            while len(self.made) < most:
                point = choose(KNOBS, self.made, self.needed, budget - self.spent)
                if point is None:
                    break
                self.make(point)
        return [one.point for one in self.made]


FACTOR = st.floats(0.3, 4.0)
WORLDS = st.builds(
    World,
    st.tuples(*(st.tuples(st.just(1.0), *[FACTOR] * (len(knob.levels) - 1)) for knob in KNOBS)),
    st.tuples(*(st.tuples(st.just(0.0), *[st.floats(-2, 2)] * (len(knob.levels) - 1)) for knob in KNOBS)),
)


@settings(max_examples=60, deadline=None)
@given(WORLDS, st.floats(1, 5000))
def test_a_study_starts_at_its_base_and_stays_within_its_budget(world, budget):
    points = world.run(budget)
    assert points[0] == base_of(KNOBS)
    # What is not known yet is guessed: one point alone may be dearer than its guess.
    dearest = max((sum(world.seconds(point).values()) for point in points[1:]), default=0)
    assert world.spent <= max(budget, 110) + dearest
    assert len(set(points)) == len(points)


@settings(max_examples=40, deadline=None)
@given(WORLDS)
def test_with_time_enough_every_level_is_tried_alone_first_and_it_ends(world):
    points = world.run(1e9)
    alone = singles(KNOBS)
    assert set(points[1 : 1 + len(alone)]) == set(alone)
    levels = [max(point) for point in points[1 : 1 + len(alone)]]
    assert levels == sorted(levels)  # each knob's first level before any knob's second
    assert all(point[3] == 0 for point in points[1 + len(alone) :])  # another seed combines with nothing
    assert len(points) < 3 * 2 * 2 * 2 + 2


@settings(max_examples=40, deadline=None)
@given(WORLDS, st.integers(0, 8))
def test_an_interrupted_study_goes_on_as_it_would_have(world, cut):
    whole = World(world.factors, world.gains).run(1e9)
    interrupted = World(world.factors, world.gains)
    interrupted.run(1e9, most=cut)
    again = World(world.factors, world.gains)
    again.stored = set(interrupted.stored)  # what the store holds costs nothing
    assert again.run(1e9) == whole
    assert again.spent == pytest.approx(
        sum(
            World(world.factors, world.gains).seconds(p)["train"]
            for p in whole
            if p not in interrupted.stored
        )
        + (10 if not interrupted.stored else 0)
    )


def test_costs_of_what_was_made_replace_the_guesses():
    world = World(((1, 0.5, 2), (1, 6.0), (1, 0.9), (1, 1)), ((0, -1, 1), (0, 1), (0, 0), (0, 0)))
    world.make((0, 0, 0, 0))
    assert Design(KNOBS, world.made).seconds((0, 1, 0, 0), STAGES) == pytest.approx(10 + 300)
    world.make((0, 1, 0, 0))
    design = Design(KNOBS, world.made)
    assert design.seconds((2, 1, 0, 0), ("train",)) == pytest.approx(100 * 2 * 6)
    assert design.gain(1, 1) == pytest.approx(1) and math.isnan(design.gain(0, 2))


def test_a_combination_of_two_good_levels_is_found():
    world = World(((1, 0.5, 2), (1, 1.5), (1, 0.9), (1, 1)), ((0, -1, 1), (0, 1), (0, -0.5), (0, 0.1)))
    points = world.run(1e9)
    assert (2, 1, 0, 0) in points
    made = {one.point: one for one in world.made}
    assert max(one.quality for one in world.made) == made[2, 1, 0, 0].quality == pytest.approx(32)


def test_failed_points_are_not_tried_again_and_lead_nowhere():
    world = World(((1, 0.5, 2), (1, 1.5), (1, 0.9), (1, 1)), ((0, -1, 1), (0, 1), (0, -0.5), (0, 0.1)))
    world.make((0, 0, 0, 0))
    world.made.append(Made((0, 1, 0, 0), {}, math.nan, math.nan))
    points = world.run(1e9)
    assert all(point[1] == 0 for point in points if point != (0, 1, 0, 0))


def test_what_the_store_holds_is_taken_up_when_the_budget_is_spent():
    world = World(((1, 0.5, 2), (1, 1.5), (1, 0.9), (1, 1)), ((0, -1, 1), (0, 1), (0, -0.5), (0, 0.1)))
    world.make((0, 0, 0, 0))
    world.stored |= {(1, 0, 0, 0), (1, 1, 0, 0)}
    for choose, point in ((next_single, (1, 0, 0, 0)), (next_combination, None)):
        assert choose(KNOBS, world.made, world.needed, -5.0) == point
    assert next_single(KNOBS, world.made, lambda point: ("train",), -5.0) is None


def test_words_and_labels_of_a_point():
    assert words_of(KNOBS, (2, 1, 0, 0)) == {"a": "200", "b": "large"}
    assert label_of(KNOBS, (2, 1, 0, 0)) == "200, large" and label_of(KNOBS, base_of(KNOBS)) == "base"
