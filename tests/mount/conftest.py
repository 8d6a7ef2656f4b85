"""What tests of mounts share: the rover that comes along."""

import pytest

from codesign.mount import Body
from scenes import robots


@pytest.fixture(scope="session")
def rover():
    """Its body, less the link that carries the camera."""
    return Body.of(robots.from_urdf(robots.ROVER).parts, without=["camera_link"])
