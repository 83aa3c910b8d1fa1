"""A short campaign in the ordinary tests; the full one is `make fleet-campaign`."""

import shapely
from campaign import Campaign


def test_what_must_hold_holds_through_faults_of_every_link(tmp_path):
    field = Campaign(110, tmp_path).play(70)
    assert field.broken == {}
    assert sum(uav.flights for uav in field.uavs) >= 10
    # It would see two at one point, and two that meet.
    field.now, (one, other) = 1.0, field.uavs[:2]
    for uav, place in ((one, 0j), (other, 5j)):
        uav.strayed = False
        uav.air_since = 1.0
        vars(uav.copter).update(place=place, landed=True, mode=4, velocity=5 + 0j)
    field.check()
    assert [*field.broken] == ["no two at one point"]
    for uav, ends in ((one, [(0, 0), (100, 100)]), (other, [(0, 100), (100, 0)])):
        uav.way = 20.0, shapely.LineString(ends)
    field.check()
    assert [*field.broken] == ["no two at one point", "no two paths too near"]
