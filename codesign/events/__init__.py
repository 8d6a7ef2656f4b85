"""Events: from frames to counts, streams and volumes, hard and differentiable.

Differentiable: ``memory`` (default), ``soft_counts``, ``soft``. Hard: ``simulate`` (sensor), ``naive`` (frame difference).
"""

from codesign.events.files import read, write
from codesign.events.intensity import lin_log
from codesign.events.memory import memory, soft_counts
from codesign.events.naive import naive
from codesign.events.sensor import SensorModel, draw_shot_counts, draw_thresholds
from codesign.events.simulate import SensorState, simulate
from codesign.events.soft import soft
from codesign.events.stream import concatenate, to_counts
from codesign.events.video import decay_video, write_video
from codesign.events.view import decay, gray_picture, picture, rates
from codesign.events.volume import from_counts, from_stream

__all__ = [
    "SensorModel",
    "SensorState",
    "concatenate",
    "decay",
    "decay_video",
    "draw_shot_counts",
    "draw_thresholds",
    "from_counts",
    "from_stream",
    "gray_picture",
    "lin_log",
    "memory",
    "naive",
    "picture",
    "rates",
    "read",
    "simulate",
    "soft",
    "soft_counts",
    "to_counts",
    "write",
    "write_video",
]
