"""The rows of the benchmark of the paper preset's parts: each changes what it says, and only that."""

import dataclasses

import pytest

from benchmarks.paper_parts import BASE, CHANCE, SMALL, VARIANTS, headline, job_of


def values(job):
    """Setting's full name -> its value."""
    return {
        f"{stage}.{name}": value
        for stage, settings in job.settings.items()
        for name, value in dataclasses.asdict(settings).items()
    }


@pytest.mark.parametrize("name", [name for name in VARIANTS if name != BASE])
def test_a_row_differs_from_the_preset_in_its_own_settings(name):
    item, overrides = VARIANTS[name]
    base, row = (values(job_of("mannequin_full", {**SMALL, **more})) for more in ({}, overrides))
    assert {key for key in base if base[key] != row[key]} == set(overrides)
    assert item or name == CHANCE


def test_the_headline_names_what_costs_most():
    rows = [
        {"subject": subject, "without": name, "psnr": psnr}
        for subject in ("a", "b")
        for name, psnr in ((BASE, 20.0), (CHANCE, 20.1), ("scene", 18.5), ("opacity", 20.2))
    ]
    assert "'scene'" in headline(rows) and "+1.50 dB" in headline(rows) and "0.10 dB" in headline(rows)
    assert "chance unknown" in headline(rows[:1])
