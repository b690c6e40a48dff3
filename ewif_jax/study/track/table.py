"""The cells of a delimited text file, each row with its line."""

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from ewif_jax.study.shared.refusal import Refused

DELIMITERS = ",;\t|"
MISSING = frozenset(
    (
        "",
        "nan",
        "na",
        "n/a",
        "#n/a",
        "<na>",
        "null",
        "none",
        "nil",
        "nat",
        "missing",
        "-",
        "--",
        "?",
    )
)
"""How programs write that there is no value, in lower case."""


class Table(NamedTuple):
    """path; names: of the columns; rows: stripped cells, as many as names; line: of each row's
    first cell in the file; delimiter; skipped: how many lines were left out, by reason."""

    path: Path
    names: list[str]
    rows: list[list[str]]
    line: list[int]
    delimiter: str
    skipped: dict[str, int]

    def column(self, name: str) -> list[str]:
        """The cells of one column.

        Raises:
            Refused: two columns have this name.
        """
        count = self.names.count(name)
        if count > 1:
            raise Refused(f"{self.path}: has {count} columns {name!r}; give each its own name")
        index = self.names.index(name)
        return [row[index] for row in self.rows]

    def refuse(self, row: int, name: str, expected: str, got: object = None) -> Refused:
        """What a cell should have been and is."""
        cell = self.column(name)[row] if got is None else got
        where = f"{self.path}, line {self.line[row]}, column {name!r}"
        return Refused(f"{where}: expected {expected}, got {cell!r}")


def is_missing(cell: str) -> bool:
    """Whether a cell says that there is no value."""
    return cell.lower() in MISSING


def read_table(path: Path) -> Table:
    """All cells of the file as stripped text.

    The delimiter is the one of `DELIMITERS` that cuts the header into most names. Lines that begin
    with # are comments, except the last before the data where it names as many columns as they
    have (so AIS archives begin: "# Timestamp,...").

    Raises:
        Refused: the file, and the line where there is one; see `readings.read`.
    """
    lines = list(enumerate(_file_text(path).splitlines(), 1))
    filled = [(n, line) for n, line in lines if line.strip()]
    if not filled:
        raise Refused(f"{path}: is empty")
    given = None
    if filled[0][1].lower().startswith("sep=") and len(filled[0][1].strip()) == 5:
        given, filled = filled[0][1].strip()[-1], filled[1:]
    number, header, comments = _header_line(path, filled, given)
    delimiter = given or _delimiter_of(header)
    names = [name.strip() for name in next(csv.reader([header], delimiter=delimiter))]
    if all(_is_number(name) for name in names):
        raise Refused(f"{path}, line {number}: expected names of columns, got numbers: {header!r}")
    body = [(n, line) for n, line in lines if n > number]
    skipped = {"comment lines": comments + sum(line.startswith("#") for _, line in body)}
    kept = [(n, line) for n, line in body if not line.startswith("#")]
    rows, starts, short = [], [], 0
    for start, row in _record_cells(path, kept, delimiter):
        cells = [cell.strip() for cell in row]
        while len(cells) > len(names) and not cells[-1]:
            cells.pop()
        if not any(cells):
            continue
        if len(cells) > len(names):
            raise Refused(
                f"{path}, line {start}: expected {len(names)} cells as in the header "
                f"({', '.join(names)}), got {len(cells)}: {delimiter.join(cells)!r}"
            )
        short += len(cells) < len(names)
        rows.append(cells + [""] * (len(names) - len(cells)))
        starts.append(start)
    skipped["cells missing at the end of the row"] = short
    if not rows:
        raise Refused(f"{path}: has a header but no rows")
    return Table(path, names, rows, starts, delimiter, {k: n for k, n in skipped.items() if n})


def _file_text(path: Path) -> str:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise Refused(f"{path}: no such file") from None
    kind = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = data.decode(kind)
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise Refused(f"{path}, line {line}: is not a text file in UTF-8: {error.reason}") from None
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise Refused(f"{path}, line {line}: is not a text file: it has a zero byte")
    # other line ends that Python knows may stand inside a cell
    return text.replace("\r\n", "\n").replace("\r", "\n").translate(_ENDS)


_ENDS = str.maketrans(dict.fromkeys("\x0b\x0c\x1c\x1d\x1e\x85\u2028\u2029", " "))


def _header_line(
    path: Path, filled: list[tuple[int, str]], given: str | None
) -> tuple[int, str, int]:
    """Line number and text of the header, and how many comment lines are above it."""
    comments = 0
    while comments < len(filled) and filled[comments][1].startswith("#"):
        comments += 1
    following = filled[comments][1] if comments < len(filled) else None
    if comments:
        number, last = filled[comments - 1]
        named = last.lstrip("#").strip()
        if following is None or _names_columns(named, following, given):
            return number, named, comments - 1
    if following is None:
        raise Refused(f"{path}: is empty")
    return filled[comments][0], following, comments


def _names_columns(comment: str, data: str, given: str | None) -> bool:
    """Whether a comment is the header of a line of data."""
    delimiter = given or _delimiter_of(comment)
    names, cells = (next(csv.reader([text], delimiter=delimiter)) for text in (comment, data))
    return (
        len(names) == len(cells) > 1
        and any(_is_number(cell) for cell in cells)
        and not any(_is_number(name) for name in names)
    )


def _delimiter_of(header: str) -> str:
    return max(DELIMITERS, key=lambda mark: len(next(csv.reader([header], delimiter=mark))))


def _record_cells(
    path: Path, lines: list[tuple[int, str]], delimiter: str
) -> Iterator[tuple[int, list[str]]]:
    """The line where each row begins, and its cells; a cell in quotes may go over several lines."""
    reader = csv.reader((line + "\n" for _, line in lines), delimiter=delimiter, strict=True)
    done = 0
    while True:
        begin = lines[done][0] if done < len(lines) else 0
        try:
            row = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            why = str(error)
            if "end of data" in why or "field limit" in why:
                why = "a quote opens here and is not closed"
            raise Refused(f"{path}, line {begin}: {why}") from None
        over = lines[done : reader.line_num]
        done = reader.line_num
        # A quote that is closed by the next row that has one swallows the rows between.
        inner = [line for _, line in over[1:-1] if line.count(delimiter) >= len(row) - 1 > 0]
        last = len(over) > 1 and over[-1][1].split('"')[0].count(delimiter) >= len(row) - 1 > 0
        if inner or last:
            raise Refused(
                f"{path}, line {begin}: a quote opens here and is closed in line {over[-1][0]}, "
                "with whole rows between"
            )
        yield begin, row


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.strip().lower() not in MISSING
