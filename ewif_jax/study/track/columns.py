"""Which column of a file is what."""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from ewif_jax.study.shared.refusal import Refused
from ewif_jax.study.track.table import Table, is_missing

# names as `simple` writes them, the surest first
TIMES = (
    "validitytime",
    "lastposupdate",
    "time",
    "timestamp",
    "basedatetime",
    "datetime",
    "timeutc",
    "utctime",
    "datetimeutc",
    "timestamputc",
    "utc",
    "epoch",
    "unixtime",
    "t",
    "date",
)
DATES = ("date", "dateutc", "utcdate", "day")
ARRIVALS = (
    "arrival",
    "arrivaltime",
    "received",
    "receivedtime",
    "receivedat",
    "reporttime",
    "time",
)
TRACKS = (
    "track",
    "trackid",
    "icao24",
    "mmsi",
    "vesselid",
    "vessel",
    "shipid",
    "ship",
    "imo",
    "callsign",
    "deviceid",
    "device",
    "objectid",
    "object",
    "targetid",
    "target",
    "tagid",
    "id",
)
SENSORS = ("sensor", "sensorid")
LATLON = (("lat", "lon"), ("latitude", "longitude"), ("lat", "lng"), ("lat", "long"))
VALUES = (("x", "y", "z"), ("x", "y"), ("east", "north"), ("x",), ("value",))
NORTH, EAST = {"n": 1, "north": 1, "s": -1, "south": -1}, {"e": 1, "east": 1, "w": -1, "west": -1}
NORTHS = (
    "ns",
    "latns",
    "nsindicator",
    "latdir",
    "latitudedirection",
    "lathemisphere",
    "latref",
    "latitudehemisphere",
    "northsouth",
    "latitudens",
)
EASTS = (
    "ew",
    "lonew",
    "ewindicator",
    "londir",
    "longitudedirection",
    "lonhemisphere",
    "lonref",
    "longitudehemisphere",
    "eastwest",
    "longitudeew",
)
NONE = "none"
"""what an option says for "the file has no such column", so that a guess can be refused"""


class Columns(NamedTuple):
    """Names of the columns; None where the file has no such thing. guessed: the roles for which no
    column was given; date: of the days that `time` belongs to; hemispheres: beside the values."""

    time: str
    arrival: str | None
    track: str | None
    sensor: str | None
    values: tuple[str, ...]
    geographic: bool
    date: str | None = None
    hemispheres: tuple[str | None, ...] = ()
    guessed: tuple[str, ...] = ()

    def __str__(self) -> str:
        roles = {
            "time": self.time,
            "date": self.date,
            "arrival": self.arrival,
            "track": self.track,
            "sensor": self.sensor,
            "lat, lon" if self.geographic else "values": ", ".join(self.values),
            "N/S, E/W": ", ".join(name for name in self.hemispheres if name) or None,
        }
        shown = [
            f"{role} {name}" + (" (guessed)" if role in self.guessed else "")
            for role, name in roles.items()
            if name is not None
        ]
        return f"Columns: {'; '.join(shown)}."


def simple(name: str) -> str:
    """A column's name without units in brackets, marks and capitals."""
    return re.sub(r"[\W_]", "", re.sub(r"\[.*?\]|\(.*?\)", "", name)).lower()


def choose_columns(
    table: Table,
    *,
    time: str | None = None,
    date: str | None = None,
    arrival: str | None = None,
    track: str | None = None,
    sensor: str | None = None,
    values: Sequence[str] | None = None,
    latlon: Sequence[str] | None = None,
) -> Columns:
    """The columns that were named, and guesses from common names for the others.

    Raises:
        Refused: a column is not there, or none or several could be what is needed.
    """
    guessed: list[str] = []

    def pick(
        role: str, given: str | None, names: Iterable[str], taken: Sequence[str] = ()
    ) -> str | None:
        if given is not None:
            return (
                None
                if given == NONE and NONE not in table.names
                else _given_columns(table, role, given)
            )
        for name in names:
            match = [x for x in table.names if simple(x) == name and x not in taken]
            if len(set(match)) > 1:
                raise Refused(
                    f"{table.path}: has columns {' and '.join(map(repr, match))}; say which one "
                    f"(--{role})"
                )
            if match:
                guessed.append(role)
                return match[0]
        return None

    when = pick("time", time, TIMES)
    if when is None:
        raise Refused(
            f"{table.path}: say which column is the time (--time); {_listed_names(table.names)}"
        )
    if latlon is not None and len(latlon) != 2:
        raise Refused(f"--latlon: expected two columns, got {','.join(latlon)}")
    if latlon is not None:
        where = tuple(_given_columns(table, "latlon", name) for name in latlon)
    elif values is not None:
        where = None
    else:
        where = _first_group(table, LATLON, guessed, "lat, lon", "latlon")
    what = where
    if what is None and values is not None:
        what = tuple(_given_columns(table, "values", name) for name in values)
    if what is None:
        what = _first_group(table, VALUES, guessed, "values", "values")
    if what is None:
        raise Refused(
            f"{table.path}: say which columns are measured (--values or --latlon); "
            f"{_listed_names(table.names)}"
        )
    used = (when, *what)
    day = pick("date", date, DATES, used) if date is not None or _of_day(table, when) else None
    sides: tuple[str | None, ...] = ()
    if where is not None:
        sides = tuple(
            _hemisphere_column(table, name, letters, names)
            for name, letters, names in zip(where, (NORTH, EAST), (NORTHS, EASTS), strict=True)
        )
    return Columns(
        when,
        pick("arrival", arrival, ARRIVALS, (*used, day or when)),
        pick("track", track, TRACKS, used),
        pick("sensor", sensor, SENSORS, used),
        what,
        where is not None,
        day,
        sides,
        tuple(guessed),
    )


def _of_day(table: Table, name: str) -> bool:
    from ewif_jax.study.track.times import is_of_day

    return is_of_day(table.column(name))


def _given_columns(table: Table, role: str, name: str) -> str:
    plain = {x.lstrip("#").strip(): x for x in (*table.names, name)}
    name = plain[name.lstrip("#").strip()] if name not in table.names else name
    if name not in table.names:
        raise Refused(
            f"{table.path}: has no column {name!r} for --{role}; {_listed_names(table.names)}"
        )
    return name


def _first_group(
    table: Table,
    groups: Iterable[tuple[str, ...]],
    guessed: list[str],
    role: str,
    option: str,
) -> tuple[str, ...] | None:
    """The first group of names of which the file has all."""
    named = [simple(name) for name in table.names]
    for group in groups:
        if all(name in named for name in group):
            for name in group:
                match = {x for x in table.names if simple(x) == name}
                if len(match) > 1:
                    both = " and ".join(map(repr, sorted(match)))
                    raise Refused(f"{table.path}: has columns {both}; say which (--{option})")
            guessed.append(role)
            return tuple(table.names[named.index(name)] for name in group)
    return None


def _hemisphere_column(
    table: Table, name: str, letters: dict[str, int], names: Sequence[str]
) -> str | None:
    """The column of hemispheres that belongs to a column of degrees: by its name, or next to it and
    with nothing else in it."""
    index = table.names.index(name)
    near = [table.names[i] for i in (index + 1, index - 1) if 0 <= i < len(table.names)]
    for other in (*(x for x in table.names if simple(x) in names), *near):
        cells = [cell.lower() for cell in table.column(other) if not is_missing(cell)]
        if cells and all(cell in letters for cell in cells):
            return other
    return None


def _listed_names(have: Sequence[str]) -> str:
    return f"it has {', '.join(have)}"
