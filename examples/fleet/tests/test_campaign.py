"""A short campaign in the ordinary tests; the full one is `make fleet-campaign`."""

from campaign import Campaign


def test_what_must_hold_holds_through_faults_of_every_link(tmp_path):
    field = Campaign(1, tmp_path).play(10, every=5.0, afterwards=180.0)
    assert field.broken == {}
    assert sum(uav.flights for uav in field.uavs) >= 10
    # It would see two at one point, and two that meet.
    field.now, (one, other) = 1.0, field.uavs[:2]
    for uav, place in ((one, 0j), (other, 5j)):
        uav.strayed, uav.air_since = False, 1.0
        vars(uav.copter).update(place=place, landed=True, mode=4, velocity=5 + 0j)
    field.check()
    assert [*field.broken] == ["no two at one point"]
    for uav, goal in ((one, 100j), (other, -100j)):
        vars(uav.copter).update(landed=False, position_control=True, goal=(goal, 20.0), height=20.0)
    field.check()
    assert [*field.broken] == ["no two at one point", "no two paths too near"]
