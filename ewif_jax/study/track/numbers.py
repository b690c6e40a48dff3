"""Columns of text as numbers: decimal points or commas, and marks between thousands."""

import re
from collections.abc import Sequence

import numpy as np

from ewif_jax.study.shared.refusal import Refused
from ewif_jax.study.track.table import Table, is_missing

PLAIN = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
SPACED = re.compile(r"(?<=\d)[ '\u2019\u00a0\u202f](?=\d{3}(\D|$))")
"""a space or apostrophe between thousands"""
POINTS = (
    re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d*"),  # 1,234.5
    re.compile(r"[+-]?\d{1,3}(,\d{3}){2,}"),  # 1,234,567
    re.compile(r"[+-]?\d*\.(\d{0,2}|\d{4,})([eE][+-]?\d+)?"),  # 1.5
)
COMMAS = (
    re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d*"),  # 1.234,5
    re.compile(r"[+-]?\d{1,3}(\.\d{3}){2,}"),  # 1.234.567
    re.compile(r"[+-]?\d*,(\d{0,2}|\d{4,})([eE][+-]?\d+)?"),  # 1,5
    re.compile(r"[+-]?0?,\d+([eE][+-]?\d+)?"),  # 0,125
)
EITHER = re.compile(r"[+-]?\d{1,3},\d{3}")  # 1,234


def decimal_mark(table: Table, names: Sequence[str], given: str | None = None) -> str:
    """The mark of decimals, "." or ",", that the cells of the columns leave no doubt about; one for
    the file.

    Raises:
        Refused: some say one and some the other, or they can be read either way.
    """
    if given is not None:
        return given
    point = comma = either = None
    for name in names:
        for row, cell in enumerate(table.column(name)):
            text = SPACED.sub("", cell)
            if text.isdigit():
                continue
            if comma is None and any(kind.fullmatch(text) for kind in COMMAS):
                comma = (row, name, cell)
            elif point is None and any(kind.fullmatch(text) for kind in POINTS):
                point = (row, name, cell)
            elif either is None and EITHER.fullmatch(text):
                either = (row, name, cell)
    if comma and point:
        where = [
            f"line {table.line[row]}, column {name!r} has {cell!r}"
            for row, name, cell in sorted((comma, point))
        ]
        raise Refused(f"{table.path}: decimal points and decimal commas: {' and '.join(where)}")
    if either and not (comma or point):
        row, name, cell = either
        raise Refused(
            f"{table.path}, line {table.line[row]}, column {name!r}: {cell!r} has a decimal comma "
            "or a comma between thousands; say --decimal , or --decimal ."
        )
    return "," if comma else "."


def to_numbers(
    table: Table, name: str, decimal: str, cells: Sequence[str] | None = None
) -> np.ndarray:
    """A column (N,) as floats, NaN where a cell says that there is no value.

    Raises:
        Refused: a cell is not a finite number; the line, the column and the cell.
    """
    found = np.full(len(table.rows), np.nan)
    for row, cell in enumerate(table.column(name) if cells is None else cells):
        if is_missing(cell):
            continue
        text = plain_number(cell, decimal)
        number = np.nan if text is None else float(text)
        if not np.isfinite(number):
            raise table.refuse(row, name, "a number", cell)
        found[row] = number
    return found


def plain_number(cell: str, decimal: str) -> str | None:
    """A number as Python writes it, or None."""
    text = cell
    if not PLAIN.fullmatch(text) or decimal == ",":
        text = SPACED.sub("", cell)
        between = "." if decimal == "," else ","
        if between in text:
            whole, mark, rest = text.partition(decimal)
            if not re.fullmatch(rf"[+-]?\d{{1,3}}({re.escape(between)}\d{{3}})+", whole):
                return None
            text = whole.replace(between, "") + mark + rest
        text = text.replace(decimal, ".")
    return text if PLAIN.fullmatch(text) else None
