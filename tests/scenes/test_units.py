"""The hint that a file is not in metres."""

import warnings

import pytest

from scenes import units


@pytest.mark.parametrize(
    ("low", "high", "unit_m", "sentence"),
    [
        ((-200, 0, 0), (200, 260, 300), 1.0, r"is 400 m wide; .* unit_m=0.01 \(centimetres: 4 m\)"),
        ((0, 0, 0), (300, 1, 1), 0.01, r"give unit_m=0.001 \(millimetres: 30 m\)"),
        ((0, 0, 0), (0.001, 0, 0), 0.001, "is 0.001 m wide; .* give a larger unit_m"),
    ],
)
def test_what_is_no_room_in_metres_gets_a_hint(low, high, unit_m, sentence):
    with pytest.warns(UserWarning, match=f"^the scene .*{sentence}") as found:
        told = units.hint(low, high, "the scene 'a.xml'", unit_m)
    assert str(found[0].message) == told


def test_what_lies_far_from_the_origin_gets_a_warning():
    """A metre at map coordinates: neighbours in single precision lie a quarter of a metre apart."""
    with pytest.warns(UserWarning, match=r"lies 4e\+06 m from the origin, .* 0.48 m in single"):
        assert units.hint((5e5, 4e6, 0), (5e5 + 1, 4e6 + 1, 1)) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert units.hint((100, 200, 0), (101, 201, 1)) is None


@pytest.mark.parametrize("size_m", [0.01, 4.0, 28.0, 100.0])
def test_rooms_robots_and_parts_get_no_hint(size_m):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert units.hint((0, 0, 0), (size_m, 0, 0)) is None
