"""A seeded attack: random models and streams against every estimator and every entry.

Every outcome is one of: right by an oracle (the NumPy Kalman filter of `attack_worlds`), right by
the invariants, refused by the name of an argument. Anything else is listed with its seed, and the
exit status is 1.

usage: PYTHONPATH=tests python tests/faults/attack.py [--full] [--only NAME ...] [--seeds A:B]
"""

import argparse
import collections
import faulthandler
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script it finds its neighbours

from contracts.registry import ROWS

from faults import attack_drawn, attack_entries
from faults.attack_filters import (
    Outcome,
    attack_drawn_ones,
    attack_entries_agree,
    attack_loss,
    attack_smoother,
    attack_values,
    row_of,
)
from faults.attack_smoothers import ALL_DATA

SMALL, SHAPES = (3, 2, 2), ((1, 1, 1), (2, 1, 2), (3, 2, 2), (4, 2, 3), (8, 4, 3))
"""(states, components, sensors)."""
BENT = ("extended", "unscented", "rts_reference", "al1", "asd")
CI = ("kalman", "ewif", "replay")


class Job(NamedTuple):
    """Whose input it is (a row of the table), what is tried, and with which arguments."""

    label: str
    attempt: Callable[..., Outcome]
    arguments: tuple


def of_estimator(name: str, seeds: range | None) -> Iterator[Job]:
    """All that is tried with one filter."""
    needs_key, single = row_of(name).needs_key, (SMALL, np.float32)
    for shape in SHAPES[:3] if needs_key else SHAPES:
        for s in seeds or range(40 if needs_key else 60):
            yield Job(name, attack_values, (name, s, shape, np.float64))
    for s in seeds or range(40):
        yield Job(name, attack_values, (name, s, *single))
    for s in seeds or range(10):
        yield Job(name, attack_entries_agree, (name, s, SMALL))
    if row_of(name).differentiable:
        for s in seeds or range(20):
            yield Job(name, attack_loss, (name, s, SMALL))
    if name in BENT or needs_key:
        for s in seeds or range(40):
            yield Job(name, attack_values, (name, s, SMALL, np.float64, True))
    if name in attack_drawn.BUILD:
        for s in seeds or range(20):
            yield Job(name, attack_drawn_ones, (name, s))


def of_smoother(name: str, seeds: range | None) -> Iterator[Job]:
    for shape in SHAPES:
        for s in seeds or range(40):
            yield Job(name, attack_smoother, (name, s, shape, np.float64))
    for s in seeds or range(40):
        yield Job(name, attack_smoother, (name, s, SMALL, np.float32))


def of_entries(count: int, seeds: range | None) -> Iterator[Job]:
    for s in seeds or range(count):
        yield Job("entries", lambda seed: Outcome(*attack_entries.attempt(seed)), (s,))


def plan(full: bool, only: list[str], seeds: range | None) -> Iterator[Job]:
    """Every input."""
    everything = [*(row.name for row in ROWS), *ALL_DATA, "entries"]
    for name in only or (everything if full else [*CI, "entries"]):
        if name == "entries":
            yield from of_entries(1500 if full else 120, seeds)
        elif name in ALL_DATA:
            yield from of_smoother(name, seeds)
        elif full:
            yield from of_estimator(name, seeds)
        else:
            for s in seeds or range(25):
                yield Job(name, attack_values, (name, s, SMALL, np.float64))


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--full", action="store_true", help="10,000 inputs, every estimator")
    parser.add_argument("--only", nargs="*", default=[], help="names of estimators, or `entries`")
    parser.add_argument("--seeds", default="", help="A:B")
    given = parser.parse_args(arguments)
    seeds = range(*map(int, given.seeds.split(":"))) if given.seeds else None
    table: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    faults = []
    for count, job in enumerate(plan(given.full, given.only, seeds)):
        faulthandler.dump_traceback_later(300, exit=True)  # a hang says where, and ends
        if count % 400 == 399:
            jax.clear_caches() if given.full else None
        outcome = job.attempt(*job.arguments)
        table[job.label][outcome.kind] += 1
        if outcome.kind.isupper():
            faults.append(f"{job.label}: {outcome.kind} {outcome.what}  {job.arguments}")
            print(faults[-1], flush=True)
    faulthandler.cancel_dump_traceback_later()
    kinds = sorted({kind for row in table.values() for kind in row})
    print("\n" + " | ".join(["estimator", *kinds]))
    for label, row in table.items():
        print(" | ".join([label, *(str(row[kind]) for kind in kinds)]))
    total = sum(sum(row.values()) for row in table.values())
    print(f"{total} inputs, {len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    sys.exit(main(sys.argv[1:]))
