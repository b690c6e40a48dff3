"""Columns of text as seconds: numbers, ISO 8601, and dates whose order the file decides."""

import datetime
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ewif_jax.study.shared.refusal import Refused
from ewif_jax.study.track.numbers import plain_number
from ewif_jax.study.track.table import Table, is_missing

CLOCK = r"(?P<h>\d{1,2}):(?P<m>\d{2})(:(?P<s>\d{2}([.,]\d*)?))?(\s*(?P<half>[AaPp][Mm]))?"
ZONE = r"\s*(?P<zone>Z|z|UTC|GMT|[+-]\d{2}(:?\d{2})?)?"
ISO = r"(?P<y>\d{4})(?P<sep>[-/.])(?P<a>\d{1,2})(?P=sep)(?P<b>\d{1,2})"
LAST = r"(?P<a>\d{1,2})(?P<sep>[-/.])(?P<b>\d{1,2})(?P=sep)(?P<y>\d{4})"
NAMED = r"(?P<b>\d{1,2})[- ](?P<a>[A-Za-z]{3})[- ](?P<y>\d{4})"
AFTER = rf"([T ]\s*{CLOCK}{ZONE})?"
COMPACT = re.compile(
    r"(?P<y>\d{4})(?P<a>\d{2})(?P<b>\d{2})T(?P<h>\d{2})(?P<m>\d{2})(?P<s>\d{2}([.,]\d*)?)"
    rf"(?P<half>\b\B)?{ZONE}"
)
YEAR_FIRST, YEAR_LAST = re.compile(ISO + AFTER), re.compile(LAST + AFTER)
MONTH_NAMED, OF_DAY = re.compile(NAMED + AFTER), re.compile(CLOCK + ZONE)
MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
EPOCH = datetime.date(1970, 1, 1).toordinal()
SCALES = (
    (1e11, 1.0, "seconds"),
    (1e14, 1e3, "milliseconds since 1970"),
    (1e17, 1e6, "microseconds since 1970"),
    (1e20, 1e9, "nanoseconds since 1970"),
)  # below
"""Numbers below the first are seconds: as seconds since 1970 it would be the year 5138."""


class Times(NamedTuple):
    """seconds (N,), since 1970 for dates; kind: how the column was read."""

    seconds: np.ndarray
    kind: str


def is_of_day(cells: Sequence[str]) -> bool:
    """Whether the column has times of day without a date."""
    first = next((cell for cell in cells if not is_missing(cell)), "")
    return OF_DAY.fullmatch(first) is not None


def to_seconds(
    table: Table,
    name: str,
    *,
    decimal: str,
    dates: str | None = None,
    date: str | None = None,
) -> Times:
    """A column as seconds; with `date`, the column of the days that its times belong to.

    Dates with the year last are day-first or month-first as any of them shows, for the file, or
    as `dates` says. Times without a zone are taken as UTC.

    Raises:
        Refused: the line, the column and the cell that cannot be read, or the option that settles
            what can be read in two ways.
    """
    cells = table.column(name)
    if date is not None:
        days = table.column(date)
        cells = [f"{day} {cell}" if cell else "" for day, cell in zip(days, cells, strict=True)]
    elif is_of_day(cells):
        raise Refused(
            f"{table.path}: column {name!r} has times of day; say which column is the date (--date)"
        )
    empty = next((row for row, cell in enumerate(cells) if is_missing(cell)), None)
    if empty is not None:
        raise table.refuse(empty, name, "a number", cells[empty])
    if plain_number(cells[0], decimal) is None and _date_parts(cells[0]) is not None:
        found = _from_dates(table, name, cells, dates)
    else:
        found = _from_numbers(table, name, cells, decimal)
    _check_apart(table, name, cells, found)
    return found


def _from_numbers(table: Table, name: str, cells: Sequence[str], decimal: str) -> Times:
    texts = [plain_number(cell, decimal) for cell in cells]
    for row, text in enumerate(texts):
        if text is None or not abs(float(text)) < SCALES[-1][0]:
            raise table.refuse(row, name, "a number", cells[row])
    number = np.array([float(text or 0) for text in texts])
    size = np.abs(number)
    kinds = np.array([int(np.searchsorted([s[0] for s in SCALES], x, side="right")) for x in size])
    kind = kinds.max()
    if kind and (kinds != kind).any():
        row = int(np.argmax(kinds != kind))
        raise table.refuse(row, name, f"{SCALES[kind][2]} as in other rows", cells[row])
    scale = SCALES[kind][1]
    if kind:  # whole numbers are divided exactly, which their floats are not
        number = np.array([_divided_units(text or "0", int(scale)) for text in texts])
    return Times(number, SCALES[kind][2])


def _divided_units(text: str, scale: int) -> float:
    return int(text) / scale if text.lstrip("+-").isdigit() else float(text) / scale


def _date_parts(cell: str) -> re.Match[str] | None:
    kinds = (YEAR_FIRST, YEAR_LAST, MONTH_NAMED, COMPACT)
    return next((found for kind in kinds if (found := kind.fullmatch(cell))), None)


def _from_dates(table: Table, name: str, cells: Sequence[str], dates: str | None) -> Times:
    parts = []
    for row, cell in enumerate(cells):
        found = _date_parts(cell)
        if found is None or found.re is not (parts[0].re if parts else found.re):
            like = "a date and time" + (f" like {cells[0]!r}" if parts else "")
            raise table.refuse(row, name, f"{like}, with a zone as Z or +01:00 if any", cell)
        parts.append(found)
    order = _date_order(table, name, parts, dates) if parts[0].re is YEAR_LAST else "month-first"
    zoned = [bool(found["zone"]) for found in parts]
    if any(zoned) and not all(zoned):
        row = zoned.index(not zoned[0])
        what = "a time zone" if zoned[0] else "no time zone"
        raise table.refuse(row, name, f"{what} as in line {table.line[0]}", cells[row])
    seconds = np.empty(len(parts))
    for row, found in enumerate(parts):
        try:
            seconds[row] = _seconds_of(found, order)
        except ValueError as error:
            raise table.refuse(row, name, f"a date and time ({error})", cells[row]) from None
    kind = "dates" if any(zoned) else "dates, taken as UTC"
    return Times(seconds, kind + (f", {order}" if parts[0].re is YEAR_LAST else ""))


def _date_order(table: Table, name: str, parts: Sequence[re.Match[str]], given: str | None) -> str:
    """What the dates of the file show together, never row by row."""
    day = next((row for row, found in enumerate(parts) if int(found["a"]) > 12), None)
    month = next((row for row, found in enumerate(parts) if int(found["b"]) > 12), None)
    if day is not None and month is not None:
        row = max(day, month)
        other = "day" if row == month else "month"
        raise table.refuse(
            row,
            name,
            f"a {other}-first date as in line {table.line[min(day, month)]}",
            parts[row].string,
        )
    shown = "day-first" if day is not None else "month-first" if month is not None else None
    if given is not None and shown not in (None, given):
        row = day if day is not None else month
        raise table.refuse(int(row or 0), name, f"a {given} date (--dates)", parts[row or 0].string)
    if given is None and shown is None:
        raise Refused(
            f"{table.path}, line {table.line[0]}, column {name!r}: {parts[0].string!r} and all "
            "others can be day-first or month-first; say --dates day-first or --dates month-first"
        )
    return given or str(shown)


def _seconds_of(found: re.Match[str], order: str) -> float:
    if found.re is MONTH_NAMED:
        if found["a"].lower() not in MONTHS:
            raise ValueError(f"no month {found['a']}")
        month, day = MONTHS.index(found["a"].lower()) + 1, int(found["b"])
    else:
        month, day = int(found["a"]), int(found["b"])
    if order == "day-first":
        month, day = day, month
    days = datetime.date(int(found["y"]), month, day).toordinal() - EPOCH
    if found["h"] is None:
        return days * 86400.0
    hour, minute = int(found["h"]), int(found["m"])
    if found["half"]:
        if not 1 <= hour <= 12:
            raise ValueError(f"no hour {hour} {found['half']}")
        hour = hour % 12 + 12 * (found["half"].lower() == "pm")
    second = float((found["s"] or "0").replace(",", "."))
    if hour > 23 or minute > 59 or not second < 61:
        raise ValueError("no such time of day")
    return days * 86400.0 + hour * 3600 + minute * 60 + second - _zone_offset(found["zone"])


def _zone_offset(zone: str | None) -> float:
    if zone is None or zone[0] not in "+-":
        return 0.0
    digits = zone[1:].replace(":", "").ljust(4, "0")
    if int(digits[:2]) > 14 or int(digits[2:]) > 59:
        raise ValueError(f"no zone {zone}")
    return (int(digits[:2]) * 3600 + int(digits[2:]) * 60) * (-1.0 if zone[0] == "-" else 1.0)


def _check_apart(table: Table, name: str, cells: Sequence[str], times: Times) -> None:
    """Stamps that differ in the file still do as float64 seconds."""
    order = np.argsort(times.seconds, kind="stable")
    same = np.flatnonzero(np.diff(times.seconds[order]) == 0)
    for k in same:
        first, second = (int(order[i]) for i in (k, k + 1))
        if cells[first] != cells[second] and "dates" not in times.kind:
            texts = [plain_number(cells[i], ".") for i in (first, second)]
            if all(t is not None and t.lstrip("+-").isdigit() for t in texts) and int(
                texts[0] or 0
            ) != int(texts[1] or 0):
                raise table.refuse(
                    second,
                    name,
                    f"a time that float64 seconds tell from {cells[first]} of line "
                    f"{table.line[first]} (subtract the first time from all)",
                    cells[second],
                )
