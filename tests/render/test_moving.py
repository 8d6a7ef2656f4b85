"""Moving objects: the same world seen from the object's own axes, what is nearest by hand, and
gradients to object poses."""

import pytest
import torch

from codesign import lens, render
from codesign.pose import inverse, look_at, se3_exp
from codesign.render import Camera, MitsubaScene, MovingScene
from tests.numbers import D, close, f64
from tests.render.planes import START, at, even, plane
from tests.render.solids import area

TRIPLET = lens.load("cooke-triplet").scaled(0.08)
# of a camera and an object that move in all six components
POSES, OBJECTS = (
    se3_exp(torch.linspace(0, 1, 3, dtype=D)[:, None] * f64(twist))
    for twist in ([0.05, -0.03, 0.08, 0.02, -0.03, 0.05], [-0.1, 0.06, 0.04, 0.05, 0.03, -0.1])
)
POSES = START @ POSES


def camera(width=24, height=16, samples=1, optics=None):
    return Camera(optics or lens.Pinhole(8.0), width, height, 0.1, samples)


@pytest.mark.parametrize("optics", [lens.Pinhole(8.0), TRIPLET])
def test_an_object_is_seen_as_from_its_own_axes(optics):
    """Only relative motion is seen: the card before the wall through the moving camera is the still
    card through the camera in the card's axes."""
    cam = camera(12, 8, 4, optics)
    found = render.frames(cam, MovingScene(plane(2, -3.0), {"card": (plane(1), OBJECTS)}), POSES)
    # the poses are multiplied in another order: rounding times the phase gradient
    truth = render.frames(cam, plane(1), inverse(OBJECTS) @ POSES)
    close(found, truth, rtol=1e-12)
    assert not torch.allclose(found[0], found[2], rtol=1e-2)


def test_nearest_of_several_objects_and_the_background_where_nothing_is_met():
    """The near ball is 8.04 px wide each way, 0.2 / sqrt(4 - 0.04) under 8 mm, and its middle 4 px
    to one side."""

    def ball(radiance, *place):
        glow = area(radiance)
        return MitsubaScene({"ball": {"type": "sphere", "radius": 0.2, "emitter": glow}}), at(
            *place
        )[None]

    scene = MovingScene(even(70.0), {"far": ball(10.0, 0.0, 5.0), "near": ball(20.0, 0.1, 4.0)})
    away = look_at((0, 0, 2.0), (0, 0, 5.0), down=(0, 1, 0))[None]
    values = [round(v, 3) for v in render.frames(camera(33, 3), scene, away)[0, 1].tolist()]
    assert set(values) == {10.0, 20.0, 70.0}
    assert values.count(20.0) == 17
    assert values[0] == values[-1] == 70.0


@pytest.mark.parametrize("order", [(2.0, 3.0, 2.5), (3.0, 2.0, 2.5), (2.5, 3.0, 2.0)])
def test_the_nearest_of_many_is_seen_whatever_their_order(order):
    cards = {str(z): (even(100.0 * z), at(0.0, z)[None]) for z in order}
    image = render.frames(camera(5, 4), MovingScene(even(1.0, 9.0), cards), at(0.0, 0.0)[None])
    close(image, torch.full_like(image, 200.0), rtol=1e-12)


@pytest.mark.bits
def test_a_scene_without_objects_is_its_world():
    empty = MovingScene(plane(1), {})
    assert empty.names == ()
    assert torch.equal(
        render.frames(camera(), empty, POSES), render.frames(camera(), plane(1), POSES)
    )
