"""Five lenses on one sensor, which tests of cameras go through."""

import math

from codesign import lens

SENSOR_PX = (346, 260)
PITCH_MM = 18.5e-3


def fitted(name):
    """A catalogue lens scaled until its published field fills the sensor's half diagonal."""
    geo = lens.load(name)
    image_mm = float(geo.first_order().efl_mm.detach()) * math.tan(
        math.radians(lens.half_field_deg(name))
    )
    return geo.scaled(math.hypot(*SENSOR_PX) / 2 * PITCH_MM / image_mm)


OPTICS = {
    "pinhole": lambda: lens.Pinhole(8.0),
    "thin lens": lambda: lens.ThinLens(8.0, 2.0, 8.05),
    "cooke-triplet": lambda: fitted("cooke-triplet"),
    "double-gauss": lambda: fitted("double-gauss"),
    "la1509": lambda: fitted("la1509"),
}
