"""The seeded attack (see `attack`), a few inputs of each kind; `attack.py --full` has thousands."""

import numpy as np
import pytest

from faults import attack, attack_entries, attack_filters
from faults.named import is_named

SEEDS = range(12)


def listed(outcomes):
    """What is a fault among (what was tried, outcome)."""
    return [f"{tried}: {kind} {what}" for tried, (kind, what) in outcomes if kind.isupper()]


@pytest.mark.parametrize("name", attack.CI)
def test_values_are_right_by_an_oracle_or_refused(name):
    tried = ((s, attack_filters.attack_values(name, s, attack.SMALL, np.float64)) for s in SEEDS)
    outcomes = list(tried)
    assert not listed(outcomes)
    judged = sum(outcome.kind == "right by the oracle" for _, outcome in outcomes)
    assert judged > len(SEEDS) / 3  # it does compare


def test_inputs_of_other_kinds_mean_what_they_say_or_are_refused():
    label, own, call = attack_entries.ENTRIES[0]
    changes = attack_entries.CHANGES
    every = ((c.field, attack_entries.judged(label, own, call, [c])) for c in changes)
    beyond = len(changes) * len(attack_entries.ENTRIES)
    drawn = ((s, attack_entries.attempt(s)) for s in range(beyond, beyond + 30))
    assert not listed([*every, *drawn])


WERE_WRONG = {
    "rounding of rows after an exact measurement": (
        attack_filters.attack_entries_agree, "information", 3, attack.SMALL,
    ),
    "a variance that motion made negative": (
        attack_filters.attack_values, "unscented", 43, attack.SMALL, np.float64,
    ),
    "masked while nothing is known": (
        attack_filters.attack_values, "limited_memory", 2, attack.SMALL, np.float32,
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", WERE_WRONG)
def test_what_was_wrong_once(kind):
    attempt, *arguments = WERE_WRONG[kind]
    assert not listed([(kind, attempt(*arguments))])


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("tau: expected a number > 0, got 0", True),
        ("measurements.time: expected shape (T,), got shape ()", True),
        ("params['q']: expected numbers, got None", True),
        ("Incompatible shapes for broadcasting: (4,), (2, 2)", False),
        ("tau", False),
    ],
)
def test_what_counts_as_named(text, named):
    assert is_named(text) is named
