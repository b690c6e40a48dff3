"""Files of measurements as people have them: the right numbers, or a message that names where."""

import datetime

import numpy as np
import pandas as pd
import pytest

from ewif_jax.study.cli import run
from ewif_jax.study.shared.refusal import Refused
from ewif_jax.study.track.readings import read
from ewif_jax.study.track.tracks import batch

NAN = float("nan")


def utc(*when):
    return datetime.datetime(*when, tzinfo=datetime.UTC).timestamp()


DAY = utc(2024, 3, 4)
TWO = {"x": [[1], [2]]}

# text; options; what is right: time, value, track, line, arrival, kept rows, dropped, notes
RIGHT = {
    # times
    "ISO with Z": ("time,x\n2024-03-04T00:01:00Z,1\n2024-03-04T00:02:00.5Z,2\n", {},
                   {"time": [DAY + 60, DAY + 120.5]}),
    "ISO without a zone": ("time,x\n2024-03-04 00:01,1\n2024-03-04 00:02,2\n", {},
                           {"time": [DAY + 60, DAY + 120], "note": "UTC"}),
    "ISO with zones": ("time,x\n2024-03-04T01:01:00+01:00,1\n2024-03-03T18:32:00-0530,2\n", {},
                       {"time": [DAY + 60, DAY + 120]}),
    "compact ISO": ("time,x\n20240304T000100Z,1\n20240304T000200Z,2\n", {},
                    {"time": [DAY + 60, DAY + 120]}),
    "dates only": ("date,x\n2024-03-04,1\n2024-03-05,2\n", {}, {"time": [DAY, DAY + 86400]}),
    "day first": ("time,x\n04/03/2024 00:01:00,1\n13/03/2024 00:00:00,2\n", {},
                  {"time": [DAY + 60, DAY + 9 * 86400], "note": "day-first"}),
    "month first": ("time,x\n03/04/2024 00:01:00,1\n03/13/2024 00:00:00,2\n", {},
                    {"time": [DAY + 60, DAY + 9 * 86400], "note": "month-first"}),
    "day first, said": ("time,x\n04/03/2024,1\n05/03/2024,2\n", {"dates": "day-first"},
                        {"time": [DAY, DAY + 86400]}),
    "dots": ("time;x\n04.03.2024 12:00:01;1\n31.03.2024 00:00:00;2\n", {},
             {"time": [DAY + 43201, DAY + 27 * 86400]}),
    "named month": ("time,x\n04-Mar-2024 00:00:01,1\n05-Mar-2024,2\n", {},
                    {"time": [DAY + 1, DAY + 86400]}),
    "half days": ("time,x\n3/14/2024 12:00:01 AM,1\n3/14/2024 1:00:00 PM,2\n", {},
                  {"time": [DAY + 864001, DAY + 864000 + 13 * 3600]}),
    "date and time": ("date,time,x\n2024-03-04,00:01:00,1\n2024-03-05,00:00:01,2\n", {},
                      {"time": [DAY + 60, DAY + 86401]}),
    "date and time, said": ("day1,t1,x\n13/03/2024,00:01,1\n14/03/2024,00:00,2\n",
                            {"time": "t1", "date": "day1"},
                            {"time": [DAY + 9 * 86400 + 60, DAY + 10 * 86400]}),
    "milliseconds": ("time,x\n1700000000500,1\n1700000001500,2\n", {},
                     {"time": [1700000000.5, 1700000001.5], "note": "milliseconds"}),
    "microseconds": ("time,x\n1700000000500000,1\n1700000001500000,2\n", {},
                     {"time": [1700000000.5, 1700000001.5], "note": "microseconds"}),
    "nanoseconds": ("time,x\n1700000000500000000,1\n1700000001500000000,2\n", {},
                    {"time": [1700000000.5, 1700000001.5], "note": "nanoseconds"}),
    "seconds since 1970": ("time,x\n1700000000.25,1\n1700000001.25,2\n", {},
                           {"time": [1700000000.25, 1700000001.25], "note": "seconds"}),
    # cells
    "semicolons": ("time;x\n0;1\n1;2\n", {}, TWO),
    "tabs": ("time\tx\n0\t1\n1\t2\n", {}, TWO),
    "bars": ("time|x\n0|1\n1|2\n", {}, TWO),
    "sep=": ("sep=;\ntime;x\n0;1\n1;2\n", {}, {**TWO, "line": [3, 4]}),
    "decimal commas": ("time;x\n0,5;1,25\n1,5;-2,5e1\n", {},
                       {"time": [0.5, 1.5], "x": [[1.25], [-25]], "note": "decimal commas"}),
    "decimal commas in quotes": ('time,x\n"0,5","1,25"\n"1,5","2"\n', {},
                                 {"time": [0.5, 1.5], "x": [[1.25], [2]]}),
    "thousands dots": ("time;x;y\n0;1.234;1.234,5\n1;12.345;2\n", {},
                       {"x": [[1234, 1234.5], [12345, 2]]}),
    "two thousands dots": ("time;x\n0;1.234.567\n1;2.345\n", {}, {"x": [[1234567], [2345]]}),
    "thousands commas": ('time,x\n0,"1,234.5"\n1,"2,345"\n', {}, {"x": [[1234.5], [2345]]}),
    "thousands spaces": ("time;x\n0;1 234,5\n1;2\u00a0345,0\n", {}, {"x": [[1234.5], [2345]]}),
    "thousandths": ("time,x\n0,1.234\n1,2.345\n", {}, {"x": [[1.234], [2.345]]}),
    "thousandths, said": ("time;x\n0;1,234\n1;2,345\n", {"decimal": ","},
                          {"x": [[1.234], [2.345]]}),
    "words for missing": ("time,x,y\n" + "".join(
        f"{k},{word},1\n" for k, word in enumerate(("NaN", "NA", "null", "None", "N/A", "-", "?"))),
        {}, {"x": [[NAN, 1]] * 7}),
    "cells missing at the end": ("time,x,y\n0,1,2\n1,2\n", {},
                                 {"x": [[1, 2], [2, NAN]], "dropped": {"cells missing at the end "
                                                                      "of the row": 1}}),
    "empty cells too many": ("time,x\n0,1,,\n1,2,\n", {}, TWO),
    "comments": ("# by a logger\ntime,x\n0,1\n# a break\n1,2\n", {},
                 {**TWO, "line": [3, 5], "dropped": {"comment lines": 2}}),
    "a cell of two lines": ('time,note,x\n0,"two\nlines",1\n1,a,2\n', {}, {**TWO, "line": [2, 4]}),
    "byte order mark": ("\ufefftime,x\n0,1\n1,2\n", {}, TWO),
    "old Mac": ("time,x\r0,1\r1,2\r", {}, {**TWO, "line": [2, 3]}),
    "units in the header": ("Time [s],X [m]\n0,1\n1,2\n", {}, TWO),
    "unused columns of one name": ("time,x,a,a\n0,1,2,3\n1,2,3,4\n", {}, TWO),
    # columns
    "row numbers are no tracks": ("id,time,x\n1,0,1\n2,1,2\n3,2,3\n", {},
                                  {"track": ["", "", ""], "note": "differs in every row"}),
    "row numbers, said": ("id,time,x\n1,0,1\n2,1,2\n3,2,3\n", {"track": "id"},
                          {"track": ["1", "2", "3"]}),
    "no arrival, said": ("validity_time,time,x\n0,noon,1\n1,one,2\n", {"arrival": "none"}, TWO),
    "rows of no ship": ("time,mmsi,x\n0,1,1\n1,,2\n2,1,3\n", {},
                        {"track": ["1", "1"], "dropped": {"rows without the name of a track": 1}}),
    # positions
    "N/S and E/W beside": ("time,lat,ns,lon,ew\n0,33.5,S,70.5,W\n1,33.6,N,70.6,E\n", {},
                           {"x": [[-33.5, -70.5], [33.6, 70.6]]}),
    "N/S and E/W by name": ("time,lat,lon,lat_dir,lon_dir\n0,33.5,70.5,S,W\n1,33.6,70.6,S,W\n", {},
                            {"x": [[-33.5, -70.5], [-33.6, -70.6]]}),
    "N/S and E/W in the cell": ("time,lat,lon\n0,33.5S,W70.5\n1,33.6 N,70.6° E\n", {},
                                {"x": [[-33.5, -70.5], [33.6, 70.6]]}),
    "Danish AIS": ("# Timestamp,Type of mobile,MMSI,Latitude,Longitude,SOG\n"
                   "31/12/2023 00:00:00,Class A,219000001,57.1,9.9,0.0\n"
                   "31/12/2023 00:00:10,Class A,219000002,91.0,181.0,0.0\n", {},
                   {"time": [utc(2023, 12, 31), utc(2023, 12, 31) + 10], "line": [2, 3],
                    "track": ["219000001", "219000002"], "x": [[57.1, 9.9], [NAN, NAN]],
                    "dropped": {"values that AIS marks as not available": 1}}),
    "American AIS": ("MMSI,BaseDateTime,LAT,LON,SOG,COG,Heading,VesselName,CallSign\n"
                     "367000001,2024-03-04T00:00:03,30.1,-90.2,0.1,360.0,511.0,A,W1\n"
                     "367000002,2024-03-04T00:00:04,30.2,-90.3,0.1,12.0,511.0,B,W2\n", {},
                     {"time": [DAY + 3, DAY + 4], "track": ["367000001", "367000002"],
                      "x": [[30.1, -90.2], [30.2, -90.3]]}),
    "AIS speeds": ("time,sog,cog,heading\n0,102.3,360,511\n1,3,4,5\n",
                   {"values": ["sog", "cog", "heading"]}, {"x": [[NAN] * 3, [3, 4, 5]],
                    "dropped": {"values that AIS marks as not available": 1}}),
    "longitudes to 360": ("time,lat,lon\n0,1,181\n1,1,182\n", {}, {"x": [[1, 181], [1, 182]]}),
}  # fmt: skip


@pytest.mark.parametrize(("text", "options", "right"), RIGHT.values(), ids=RIGHT)
def test_what_a_file_says(tmp_path, text, options, right):
    path = tmp_path / "file.csv"
    path.write_bytes(text.encode())
    found = read(path, **options)
    for name, got in (("time", found.time), ("x", found.value), ("line", found.line)):
        if name in right:
            np.testing.assert_allclose(got, right[name], rtol=0, atol=1e-6, err_msg=name)
    if "track" in right:
        assert found.track.tolist() == right["track"]
    assert dict(found.dropped) == right.get("dropped", {})
    assert right.get("note", "") in " ".join(found.notes)


# text; options; what the message has
WRONG = {
    "row names": ("time,x\n101,0,10\n", {}, "line 2: expected 2 cells as in the header"),
    "a row too long": ("time,x\n0,1\n1,2,3\n", {}, "line 3: expected 2 cells"),
    "decimal commas between commas": ("time,x\n0,5,1,5\n", {}, "line 2: expected 2 cells"),
    "two columns x": ("time,x,x\n0,1,2\n", {}, "2 columns 'x'"),
    "two columns of a guess": ("time,x,MMSI,mmsi\n0,1,2,3\n", {}, "'MMSI' and 'mmsi'; say which"),
    "numbers for a header": ("0,1\n1,2\n", {}, "line 1: expected names of columns"),
    "an open quote": ('time,x,note\n0,1,a\n1,2,"b\n2,3,c\n', {}, "line 3: a quote opens here"),
    "a quote closed by another": ('time,x,note\n0,1,"a\n1,2,b\n2,3,"c"\n', {}, "line 2: "),
    "a quote over rows": ('time,x,note\n0,1,"a\n1,2,b\n2,3,c"\n3,4,d\n', {},
                          "line 2: a quote opens here and is closed in line 4"),
    "line after two lines": ('time,note,x\n0,"a\nb",1\n1,c,one\n', {}, "line 4, column 'x'"),
    "zero bytes": ("time,x\n0,1\0\n", {}, "line 2: is not a text file"),
    "only comments": ("# a\n# b\n", {}, "no rows"),
    "day or month": ("time,x\n03/04/2024,1\n05/06/2024,2\n", {}, "--dates day-first or"),
    "day and month": ("time,x\n13/04/2024,1\n05/16/2024,2\n", {}, "line 3, column 'time'"),
    "against --dates": ("time,x\n13/04/2024,1\n", {"dates": "month-first"}, "a month-first date"),
    "no such day": ("time,x\n2024-02-30,1\n", {}, "line 2, column 'time'"),
    "no such hour": ("time,x\n2024-02-03 25:00:00,1\n", {}, "line 2, column 'time'"),
    "mixed zones": ("time,x\n2024-03-04T00:00:00Z,1\n2024-03-04T00:01:00,2\n", {},
                    "line 3, column 'time': expected a time zone as in line 2"),
    "a zone by name": ("time,x\n2024-03-04 00:00:00 CET,1\n", {}, "line 2, column 'time'"),
    "dates and numbers": ("time,x\n2024-03-04,1\n5,2\n", {}, "line 3, column 'time'"),
    "numbers and dates": ("time,x\n5,2\n2024-03-04,1\n", {}, "line 3, column 'time'"),
    "no date": ("time,x\n00:00:01,1\n00:00:02,2\n", {}, "(--date)"),
    "seconds and milliseconds": ("time,x\n1700000000,1\n1700000001000,2\n", {}, "line 2, column"),
    "nanoseconds apart": ("time,x\n1700000000000000000,1\n1700000000000000001,2\n", {},
                          "line 3, column 'time'"),
    "times of 1e300": ("time,x\n0e300,1\n1e300,2\n", {}, "line 3, column 'time'"),
    "infinite times": ("time,x\n0,1\n1e999,2\n", {}, "line 3, column 'time'"),
    "two clocks": ("time,arrival,x\n0,1700000000,1\n1,1700000001,2\n", {}, "not of one clock"),
    "no time": ("time,x\n0,1\nNA,2\n", {}, "line 3, column 'time': expected a number, got 'NA'"),
    "points and commas": ("time;x\n0;1.5\n1;2,5\n", {},
                          "decimal points and decimal commas: line 2"),
    "commas that may be both": ("time;x\n0;1,234\n", {}, "say --decimal , or --decimal ."),
    "an arrival that is a guess": ("validity_time,time,x\n0,noon,1\n", {},
                                   "arrival time (guessed)"),
    "a minus and S": ("time,lat,ns,lon,ew\n0,-33.5,S,70.5,W\n", {}, "line 2, column 'lat'"),
    "no hemisphere": ("time,lat,ns,lon,ew\n0,33,S,70,W\n1,33,,70,W\n", {}, "line 3, column 'ns'"),
    "off the earth": ("time,lat,lon\n0,95,0\n", {}, "line 2, column 'lat': expected degrees"),
    "a hexadecimal": ("time,x\n0,0x10\n", {}, "line 2, column 'x'"),
    "underscores": ("time,x\n0,1_000\n", {}, "line 2, column 'x'"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "options", "message"), WRONG.values(), ids=WRONG)
def test_what_a_file_cannot_say(tmp_path, text, options, message):
    path = tmp_path / "file.csv"
    path.write_text(text)
    with pytest.raises(Refused) as refused:
        read(path, **options)
    assert message in str(refused.value)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize(
    "column", ["MMSI", "mmsi", "vessel_id", "callsign", "device_id", "trackid", "icao24"]
)
def test_ships_and_devices_are_tracks(tmp_path, column):
    rows = [f"{10 * k},{name},{k},{k}" for k in range(3) for name in ("367", "368")]
    path = tmp_path / "file.csv"
    path.write_text(f"time,{column},lat,lon\n" + "\n".join(rows) + "\n")
    assert batch(read(path)).name.tolist() == ["367", "368"]


def test_not_text_is_refused(tmp_path):
    path = tmp_path / "file.csv"
    path.write_bytes(b"time,x\n0,\xe9\n")
    with pytest.raises(Refused, match="line 2: is not a text file in UTF-8"):
        read(path)
    path.write_bytes("time,x\n0,1\n".encode("utf-16"))
    assert read(path).value.tolist() == [[1.0]]


def long_and_short(path):
    """30 tracks of 8 rows, and one of 400 whose rows come late now and then."""
    rng = np.random.default_rng(0)
    frames = [pd.DataFrame({"track": f"t{k:02}", "time": np.arange(n) * 1.0})
              for k, n in enumerate([8] * 15 + [400] + [8] * 15)]  # fmt: skip
    frame = pd.concat(frames, ignore_index=True)
    frame["arrival"] = frame["time"] + rng.choice([0.0, 2.5], len(frame), p=[0.8, 0.2])
    frame["x"] = frame["time"] * 2 + rng.normal(size=len(frame))
    frame["y"] = np.where(rng.random(len(frame)) < 0.9, rng.normal(size=len(frame)), np.nan)
    frame.to_csv(path, index=False)
    return frame


def test_tracks_of_like_length_go_together(tmp_path):
    path = tmp_path / "file.csv"
    frame = long_and_short(path)
    tracks = batch(read(path))
    assert [len(group.tracks) for group in tracks.groups] == [1, 30]
    assert tracks.present.size == tracks.present.sum() == len(frame)
    ordered = frame.sort_values(["track", "arrival"], kind="stable")
    np.testing.assert_array_equal(tracks.value, ordered[["x", "y"]])
    for name in ("time", "value"):
        fields = [np.asarray(getattr(group.measurements, name)) for group in tracks.groups]
        right = np.where(tracks.mask, tracks.value, 0) if name == "value" else tracks.time
        np.testing.assert_array_equal(tracks.flat(fields), right)


def test_a_short_track_is_filtered_beside_a_long_one(tmp_path, capsys, monkeypatch):
    """The long track alone, the short ones alone, and all together: the same estimates."""
    monkeypatch.setattr("ewif_jax.study.track.figures.innovation_panels", lambda *_: None)
    monkeypatch.setattr("ewif_jax.study.track.figures.track_maps", lambda *_: None)
    monkeypatch.setattr("ewif_jax.study.shared.experiment.Experiment.figure", lambda *_: None)
    frame, found = long_and_short(tmp_path / "all.csv"), {}
    for name, some in (("long", frame["track"] == "t15"), ("short", frame["track"] == "t03")):
        frame[some].to_csv(tmp_path / f"{name}.csv", index=False)
    for name in ("all", "long", "short"):
        given = [
            "track",
            str(tmp_path / f"{name}.csv"),
            "--tau",
            "5",
            "--out",
            str(tmp_path / name),
        ]
        extra = ["--warm-up", "8"] if name == "short" else []
        assert run([*given, *extra]) == 0
        found[name] = pd.read_csv(tmp_path / name / "track" / "estimates.csv")
    said = capsys.readouterr().out
    assert "--warm-up: 8 leaves no measurement to score" in said
    everything = found["all"].drop(columns="line").set_index("track")
    for name, track in (("long", "t15"), ("short", "t03")):
        alone = found[name].drop(columns="line").set_index("track")
        pd.testing.assert_frame_equal(alone, everything.loc[[track]], rtol=1e-9)
    newest = found["long"]["time"].cummax()
    np.testing.assert_array_equal(found["long"]["estimate_time"], newest)


@pytest.mark.parametrize("given", [["--lag", "100000000000", "--estimator", "al1"],
                                   ["--seed", "-1"], ["--seed", str(2**40)], ["--lag", "1e9"],
                                   ["--tune"]])  # fmt: skip
def test_options_that_cannot_be_are_a_message(tmp_path, capsys, given):
    path = tmp_path / "file.csv"
    path.write_text("time,x\n0,1\n1,2\n2,3\n")
    try:
        status = run(["track", str(path), "--out", str(tmp_path / "out"), *given])
    except SystemExit as stopped:
        status = stopped.code
    assert status == 2
    named = "--warm-up" if given == ["--tune"] else given[0]
    assert named in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["file.csv"]


def test_what_is_no_file_is_said_before_anything_is_imported(tmp_path, capsys):
    assert run(["track", str(tmp_path)]) == 2
    assert f"{tmp_path}: is not a regular file" in capsys.readouterr().err
