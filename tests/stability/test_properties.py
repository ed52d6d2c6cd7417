"""Property-based tests of the pure functions: a little by default, alike each time; much in the soak."""

import os
import random

import pytest
from hypothesis import HealthCheck, given, seed, settings

from tests.stability.properties import PROPERTIES

QUIET = [
    HealthCheck.too_slow,
    HealthCheck.data_too_large,
    HealthCheck.filter_too_much,
    HealthCheck.large_base_example,
]


def drawn(name, **limits):
    strategy, check = PROPERTIES[name]
    bounded = settings(deadline=None, database=None, suppress_health_check=QUIET, **limits)
    return bounded(given(strategy)(check))


@pytest.mark.parametrize("name", PROPERTIES)
def test_property(name):
    drawn(name, max_examples=12, derandomize=True)()


@pytest.mark.soak
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("name", PROPERTIES)
def test_property_in_the_soak(name):
    """FLEXIAVATAR_SOAK_SEED repeats a soak, FLEXIAVATAR_SOAK_EXAMPLES makes it longer."""
    number = int(os.environ.get("FLEXIAVATAR_SOAK_SEED", random.SystemRandom().randrange(2**32)))
    examples = int(os.environ.get("FLEXIAVATAR_SOAK_EXAMPLES", "1000"))
    print(f"seed {number}: {name}, {examples} examples")
    seed(number)(drawn(name, max_examples=examples))()
