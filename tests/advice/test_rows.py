"""Rows of tables: what is understood, what is refused, and that no cell of an answer is a formula."""

import csv
import io
import json

import pytest

from damian.advice.rows import Advice, Report, UavStatus, as_csv, as_rows, read_csv, read_json
from damian.common.errors import InputError

ROW = {"ID": "B", "time": 1.75e9, "lat": 52.8, "lon": -4.1, "source_spotted": 0, "battery": 80.0}


def test_columns_may_be_written_in_any_case_and_unknown_values_are_left_out():
    head = "id,TIME,Lat,lon,Source_Spotted,Takeoff-Landing time,battery,previous,readings,Motions"
    text = f"{head}\n 7 ,2026-05-01T12:00:00Z,52.8,-4.1,1.0,NA,,53.1 -4.5; 53.2 -4.5,1;2.5,3\n"
    ((where, report),) = read_csv(text)
    expected = {"id": "7", "time": 1777636800.0, "lat": 52.8, "lon": -4.1, "source_spotted": True}
    expected |= {"previous": ((53.1, -4.5), (53.2, -4.5)), "readings": (1.0, 2.5), "motions": 3}
    assert where == "line 2"
    assert report == Report(**expected)
    assert (report.place, report.source_place, report.flies) == ((52.8, -4.1), None, False)
    again = json.loads(report.model_dump_json(by_alias=True, exclude_none=True))
    assert read_json(json.dumps(again))[0][1] == report, "journals keep what was said"


def test_times_follow_from_what_a_row_says():
    def stamped(now=100.0, file=True, **said) -> tuple[float, float]:
        report = Report(**{"id": "A", "x": 0.0, "y": 0.0, **said})
        report.stamp(now, file)
        return report.time, report.received

    assert stamped() == (100.0, 100.0)
    assert stamped(aoi=3.0, file=False) == (97.0, 100.0)
    assert stamped(time=50.0, file=False) == (50.0, 100.0)
    assert stamped(time=50.0, aoi=2.0) == (50.0, 52.0)
    assert stamped(receive_time=60.0, aoi=2.0) == (58.0, 60.0)
    assert stamped(receive_time=60.0, time=50.0) == (50.0, 60.0)
    with pytest.raises(InputError, match="receive time: only damian advise reports=FILE"):
        stamped(receive_time=60.0, file=False)


REFUSED = {
    "no number": ({"battery": "full"}, "battery: 'full': Input should be a valid number"),
    "a flag": ({"battery": True}, "battery: True: it is not a number"),
    "out of range": (
        {"battery": 101},
        "battery: 101: Input should be less than or equal to 100 (Battery level",
    ),
    "no place": ({"lat": None, "lon": None}, "lat, lon: they are missing"),
    "half a place": ({"lat": None}, "lat: it is missing"),
    "two places": ({"x": 1.0}, "x, y: give all places of a row in lat, lon"),
    "another unit": (
        {"target x": 1.0, "target y": 1.0},
        "target x, target y: give all places of a row in lat",
    ),
    "a source without a time": ({"source lat": 52.8, "source lon": -4.1}, "source time: it is missing"),
    "no flag": ({"source_spotted": "maybe"}, "source spotted: 'maybe': Input should be a valid boolean"),
    "no time": ({"time": "noon"}, "time: 'noon': it is neither seconds nor a time such as"),
    "no pair": ({"previous": [[1.0]]}, "previous.0.1: it is missing"),
    "no ID": ({"ID": None}, "id: it is missing"),
    "an ID that cannot be printed": ({"ID": "a\u200bb"}, "id: 'a\\u200bb': it has characters"),
    "an unknown column": ({"speed": 3}, "'speed' is no column; they are id, receive time, aoi, time"),
    "a column twice": ({"TIME": 3}, "the column 'time' appears twice"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_row_is_refused_with_its_place_column_and_value(case):
    changed, message = REFUSED[case]
    with pytest.raises(InputError) as error:
        read_json(json.dumps([ROW, ROW | changed]))
    assert str(error.value).startswith(f"row 2: {message}")


@pytest.mark.parametrize(
    "text", ["NaN", "[[[", "[1e999]", "3", "[]", '{"a": Infinity}', "[" * 20_000, b"\xff"]
)
def test_what_is_no_row_is_refused(text):
    with pytest.raises(InputError):
        read_json(text)


ADVICE = {"heading": None, "distance": 0.0, "duration": 0.0, "arrival": 5.0, "step": 1, "age": -0.5}


@pytest.mark.parametrize("uav", ["=1+1", "+1", "-1", "@SUM(A1)", "A=1"])
def test_no_cell_of_a_table_is_a_formula(uav):
    table = as_csv([Advice(ID=uav, state="hold", lat=-52.8, lon=-4.1, **ADVICE)])
    (row,) = csv.DictReader(io.StringIO(table))
    assert row["ID"] == (uav if uav == "A=1" else f"'{uav}")
    assert (float(row["lat"]), float(row["age"]), row["heading"]) == (-52.8, -0.5, "NA")
    counts = {"reports": 0, "late": 0, "duplicates": 0}
    assert as_rows([UavStatus(ID=uav, age=None, **counts)]) == [{"ID": uav, "age": None, **counts}]
