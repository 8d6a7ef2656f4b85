"""What tests of mounts share: the rover that comes along, and a small camera."""

import pytest

from codesign import lens, render
from codesign.mount import Body
from scenes import robots


@pytest.fixture(scope="session")
def rover():
    """Its body, less the link that carries the camera."""
    return Body.of(robots.from_urdf(robots.ROVER).parts, without=["camera_link"])


@pytest.fixture(scope="session")
def camera():
    return render.Camera(lens.Pinhole(3.4), 24, 16, 0.2, 1)
