"""The hint that a file is not in metres."""

import warnings

import pytest

from scenes import units


def test_a_room_of_400_m_is_taken_for_centimetres():
    with pytest.warns(
        UserWarning, match=r"^the scene 'a.xml' is 400 m wide; .* unit_m=0.01 \(centimetres: 4 m\)"
    ) as found:
        sentence = units.hint((-200, 0, 0), (200, 260, 300), "the scene 'a.xml'")
    assert str(found[0].message) == sentence


def test_what_is_still_too_large_in_centimetres_may_be_millimetres():
    with pytest.warns(UserWarning, match=r"give unit_m=0.001 \(millimetres: 30 m\)"):
        units.hint((0, 0, 0), (300, 1, 1), unit_m=0.01)


def test_a_thing_of_a_millimetre_wants_a_larger_unit():
    with pytest.warns(UserWarning, match="is 0.001 m wide; .* give a larger unit_m"):
        units.hint((0, 0, 0), (0.001, 0, 0), unit_m=0.001)


@pytest.mark.parametrize("size_m", [0.01, 4.0, 28.0, 100.0])
def test_rooms_robots_and_parts_get_no_hint(size_m):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert units.hint((0, 0, 0), (size_m, 0, 0)) is None
