"""Windows of events with exact flow: what flow networks learn on and estimators are judged on.

``rendered``: flat layers before a moving camera (read first), which ``sensors`` sees by sensors
that all differ; ``sets``: the named mixes and sets; ``worlds``: out of the 3-D worlds;
``streams``: recordings with flow at any time. Below them ``layers`` (what moves),
``motion`` (how) and ``textures``.
"""

from codesign.doors import explain
from scenes.windows.rendered import Draws, PacketWindows, RenderedWindows, planes
from scenes.windows.sensors import Sensors, SensorWindows
from scenes.windows.sets import HARSH, SETS, TRAINING, UNSEEN, VALIDATION, Shape
from scenes.windows.streams import sliding, turning
from scenes.windows.worlds import ALL, WorldWindows

__all__ = [
    "ALL",
    "HARSH",
    "SETS",
    "TRAINING",
    "UNSEEN",
    "VALIDATION",
    "Draws",
    "PacketWindows",
    "RenderedWindows",
    "SensorWindows",
    "Sensors",
    "Shape",
    "WorldWindows",
    "planes",
    "sliding",
    "turning",
]

explain(globals())
