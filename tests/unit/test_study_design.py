"""Frontiers, the order of a tradeoff's designs, and which of them are made within its budget."""

import dataclasses
import math

import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.studies.points import combinations, frontier, noise_of, point_table, shortfalls
from pipeline.studies.search import Search
from pipeline.studies.sweep import CHANCE, Level, label_of, overrides_of
from pipeline.studies.variants import Result

NUMBERS = st.floats(-100, 100) | st.just(math.nan)
POINTS = st.lists(st.tuples(st.floats(0.1, 100) | st.just(math.nan), NUMBERS), max_size=30)


def dominates(one, other):
    return one[0] <= other[0] and one[1] >= other[1] and one != other


def columns(points):
    return pd.Series([c for c, _ in points], dtype=float), pd.Series([q for _, q in points], dtype=float)


@settings(max_examples=50, deadline=None)
@given(POINTS)
def test_a_frontier_is_what_nothing_dominates(points):
    known = [point for point in points if not any(map(math.isnan, point))]
    chosen = [points[place] for place in frontier(*columns(points))]
    assert set(chosen) == {one for one in known if not any(dominates(other, one) for other in known)}
    assert len(set(chosen)) == len(chosen)
    assert all(a[0] < b[0] and a[1] < b[1] for a, b in zip(chosen, chosen[1:], strict=False))


@settings(max_examples=50, deadline=None)
@given(POINTS, st.randoms())
def test_a_frontier_does_not_hang_on_the_order_and_is_its_own(points, random):
    def of(some):
        return [some[place] for place in frontier(*columns(some))]

    shuffled = points[:]
    random.shuffle(shuffled)
    assert of(points) == of(shuffled) == of(of(points))


@settings(max_examples=50, deadline=None)
@given(POINTS)
def test_what_lies_on_the_frontier_lacks_nothing_and_all_else_something(points):
    kept, lacks = frontier(*columns(points)), shortfalls(*columns(points))
    for place, (cost, quality) in enumerate(points):
        if not math.isnan(cost) and not math.isnan(quality):
            better = [q for c, q in points if c <= cost and q > quality]
            assert lacks[place] == pytest.approx(max(better, default=quality) - quality)
            if place in kept:
                assert lacks[place] == 0


def level(parameter, label, factor=1.0):
    return Level(parameter, f"own {parameter}", label, {parameter: label}, factor)


HALF, DOUBLE = level("iterations", "half", 0.5), level("iterations", "double", 2.0)
LARGE, WITHOUT, SEED = level("size", "large", 3.0), level("effect", "off", 0.9), level(CHANCE, "1")
LEVELS = (WITHOUT, HALF, SEED, LARGE, DOUBLE)


class World:
    """A base, store and clock where costs multiply and gains add up, as the search believes, or not quite."""

    def __init__(self, factors, gains, stored=(), surprise=0.0, failing=()):
        self.factors, self.gains = (
            dict(zip(LEVELS, factors, strict=True)),
            dict(zip(LEVELS, gains, strict=True)),
        )
        self.stored, self.surprise, self.failing = set(stored), surprise, failing
        self.now, self.made = 0.0, []

    def design_of(self, overrides):
        return tuple(one for one in LEVELS if one.overrides.items() <= overrides.items())

    def train_seconds(self, design):
        factor = math.prod(self.factors[one] for one in design)
        return 100.0 * factor * (1 + self.surprise * (len(design) % 3 - 1))

    def missing(self, stage, overrides):
        if self.design_of(overrides) in self.stored:
            return []
        return ["train"] if self.made or self.stored else ["fit", "train"]

    def run(self, variant, stages):
        design = self.design_of(variant.overrides)
        assert design not in self.made
        seconds = {"fit": 10.0, "train": self.train_seconds(design)}
        self.now += sum(seconds[stage] for stage in self.missing("train", variant.overrides))
        self.made.append(design)
        if set(design) & set(self.failing):
            return Result("ann", variant.name, "stopped")
        self.stored.add(design)
        return Result("ann", variant.name, seconds=seconds, cpu_seconds=seconds, means={"design": design})

    def search(self, budget, most=None):
        found = Search(self, budget, self.measure, lambda: self.now)
        found.make(())
        found.make_affordable([(one,) for one in LEVELS][:most])
        if most is None:
            found.make_affordable(combinations(point_table(found.results)))
        return found

    def measure(self, result):
        if result.failure:
            return result
        psnr = 30 + sum(map(self.gains.get, result.means["design"]))
        return dataclasses.replace(result, means={"avatar": {"psnr": psnr}})


FACTOR, GAIN = st.floats(0.3, 4.0), st.floats(-2, 2)
FACTORS, GAINS = st.tuples(*[FACTOR] * len(LEVELS)), st.tuples(*[GAIN] * len(LEVELS))


@settings(max_examples=30, deadline=None)
@given(FACTORS, GAINS, st.floats(1, 5000), st.floats(0, 0.9))
def test_a_study_starts_at_its_base_and_stays_within_its_budget(factors, gains, budget, surprise):
    world = World(factors, gains, surprise=surprise)
    world.search(budget)
    assert world.made[0] == ()
    # What is not known yet is guessed: one design alone may be dearer than its guess.
    dearest = max((world.train_seconds(design) for design in world.made[1:]), default=0)
    assert world.now <= max(budget, 10 + world.train_seconds(())) + dearest + 1e-6


@settings(max_examples=20, deadline=None)
@given(FACTORS, GAINS)
def test_with_time_enough_every_level_is_tried_alone_first_and_it_ends(factors, gains):
    made = World(factors, gains).search(1e9).results
    designs = list(made)
    assert designs[1 : 1 + len(LEVELS)] == [(one,) for one in LEVELS]
    for design in designs[1 + len(LEVELS) :]:
        assert len({one.parameter for one in design}) == len(design) > 1
        assert SEED not in design  # another seed combines with nothing


@settings(max_examples=20, deadline=None)
@given(FACTORS, GAINS, st.integers(0, len(LEVELS)))
def test_an_interrupted_study_goes_on_as_it_would_have(factors, gains, cut):
    whole = World(factors, gains)
    designs = list(whole.search(1e9).results)
    interrupted = World(factors, gains)
    interrupted.search(1e9, most=cut)
    again = World(factors, gains, interrupted.stored)
    assert list(again.search(1e9).results) == designs
    assert interrupted.now + again.now == pytest.approx(whole.now)  # what the store holds costs nothing


def test_measured_costs_replace_the_guesses():
    world = World((0.9, 0.5, 1, 6.0, 2.0), (0, -1, 0, 1, 1))
    search = Search(world, 1e9, world.measure, lambda: world.now)
    search.make(())
    assert search.expected_seconds((LARGE,)) == pytest.approx(300)
    search.make((LARGE,))
    assert search.expected_seconds((LARGE, DOUBLE)) == pytest.approx(100 * 2 * 6)
    world.stored.add((LARGE, DOUBLE))
    assert search.expected_seconds((LARGE, DOUBLE)) == 0


def test_a_combination_of_two_good_levels_is_found_and_the_best_for_its_time_comes_first():
    search = World((0.9, 0.5, 1, 1.5, 2), (-0.5, -1, 0.1, 1, 1)).search(1e9)
    designs = [design for design in search.results if len(design) > 1]
    assert designs[0] == (LARGE, DOUBLE)  # 1 dB each, the other way round would be dearer for its gain
    points = point_table(search.results)
    assert points["design"][points["psnr"].idxmax()] == (LARGE, DOUBLE)
    assert points["psnr"].max() == pytest.approx(32)
    assert noise_of(points) == pytest.approx(0.1)


def test_levels_that_gain_less_than_chance_and_are_beaten_are_not_combined():
    search = World((1.2, 1.3, 1, 1.5, 2), (0.09, -1, 0.1, 0.08, 1)).search(1e9)

    def combined(points):
        return {one for design in combinations(points) for one in design}

    points = point_table(search.results)
    assert noise_of(points) == pytest.approx(0.1) and combined(points) == {WITHOUT, DOUBLE}
    assert combined(points[~points["chance"]]) == {WITHOUT, LARGE, DOUBLE}  # no other seed was reached
    assert combinations(points.iloc[:1]) == []


def test_failed_designs_are_tried_once_and_lead_nowhere():
    world = World((0.9, 0.5, 1, 1.5, 2), (0.5, -1, 0.1, 1, 1), failing=[LARGE])
    search = world.search(1e9)
    assert [design for design in search.results if LARGE in design] == [(LARGE,)]
    assert search.results[(LARGE,)].failure and len(search.results) > 1 + len(LEVELS)


def test_what_the_store_holds_is_taken_up_when_the_budget_is_spent():
    world = World((0.9, 0.5, 1, 1.5, 2), (0, -1, 0, 1, 1), stored=[(), (HALF,), (LARGE,)])
    assert set(world.search(1e-9).results) >= {(), (HALF,), (LARGE,)}
    assert world.now == 0


def test_overrides_and_labels_of_a_design():
    assert overrides_of((DOUBLE, LARGE)) == {"iterations": "double", "size": "large"}
    assert label_of((DOUBLE, LARGE)) == "double, large" and label_of(()) == "base"
