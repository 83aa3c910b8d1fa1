"""Rows of tables: what is understood, and what is refused."""

import json

import pytest
from reports import read_json

from damian.common.errors import InputError
from damian_fleet.reports import Report, reports_of, rows_of_csv, rows_of_json

ROW = {"ID": "B", "time": 1.75e9, "lat": 52.8, "lon": -4.1, "source_spotted": 0, "battery": 80.0}


def test_columns_may_be_written_in_any_case_and_unknown_values_are_left_out():
    head = "id,TIME,Lat,lon,Source_Spotted,Takeoff-Landing time,battery,previous,readings,Motions"
    text = f"{head}\n 7 ,2026-05-01T12:00:00Z,52.8,-4.1,1.0,NA,,53.1 -4.5; 53.2 -4.5,1;2.5,3\n"
    ((where, report),) = reports_of(rows_of_csv(text))
    expected = {"id": "7", "time": 1777636800.0, "lat": 52.8, "lon": -4.1, "source_spotted": True}
    expected |= {"previous": ((53.1, -4.5), (53.2, -4.5)), "readings": (1.0, 2.5), "motions": 3}
    assert where == "line 2"
    assert report == Report(**expected)
    assert (report.place(), report.place("source_"), report.flies) == ((52.8, -4.1), None, False)
    again = json.loads(report.model_dump_json(by_alias=True, exclude_none=True))
    assert read_json(again)[0][1] == report, "journals keep what was said"


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
    with pytest.raises(InputError, match="receive time: only a table has it"):
        stamped(receive_time=60.0, file=False)


REFUSED = {
    "out of range": ({"battery": 101}, "battery: 101: Input should be less than or equal to 100"),
    "no time": ({"time": "noon"}, "time: 'noon': Value error, Invalid isoformat string"),
    "an ID that is a formula": ({"ID": "=1+1"}, "id: '=1+1': String should match pattern"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_row_is_refused_with_its_place_column_and_value(case):
    changed, message = REFUSED[case]
    with pytest.raises(InputError) as error:
        read_json([ROW, ROW | changed])
    assert str(error.value).startswith(f"row 2: {message}")


@pytest.mark.parametrize("text", ["NaN", "[1e999]", "3", "[]", "[" * 20_000, b"\xff"])
def test_what_is_no_row_is_refused(text):
    with pytest.raises(InputError):
        reports_of(rows_of_json(text))
