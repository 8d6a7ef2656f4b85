"""Events: from frames to counts, streams and volumes, hard and differentiable.

Hard: ``simulate`` (sensor), ``naive`` (frame difference). Differentiable: ``memory`` (default),
``soft_counts``, ``soft``, ``dense``, ``expected``, ``sensor_counts``, ``srm``; ``layer(name)``
makes a module of any of them, with learnable sensor values.
"""

from codesign.doors import explain
from codesign.events.files import read, write
from codesign.events.formats.aedat import RecordedFrames, read_frames
from codesign.events.intensity import lin_log
from codesign.events.layers.comparators import LAYERS, ComparatorLayer, layer
from codesign.events.layers.layer import EventLayer, HardSensor, PositiveValues, Settled
from codesign.events.layers.memory import memory, soft_counts
from codesign.events.layers.physical import PhysicalLayer, PhysicalState, sensor_counts
from codesign.events.layers.soft import dense, expected, soft
from codesign.events.level_path import finer
from codesign.events.low_pass import low_pass, one_pole
from codesign.events.sensor.model import PRESETS, SensorModel, draw_shot_counts, draw_thresholds
from codesign.events.sensor.simulate import dense_counts, naive, simulate
from codesign.events.sensor.state import SensorState
from codesign.events.sources.opening import open_frames
from codesign.events.spiking.losses import count_loss, van_rossum
from codesign.events.spiking.spike_esim import SpikeEsim, SpikeEsimState
from codesign.events.spiking.srm import SrmState, alpha_response, drive_scale, srm
from codesign.events.spiking.surrogate import FastSigmoid, Laplace, Triangular
from codesign.events.spiking.thesis_network import TwoBranchSpikes
from codesign.events.stream import concatenate, to_counts
from codesign.events.upsampling.upsample import upsample, upsample_stream
from codesign.events.views.pictures import decay_video, gray_picture, picture, rates, write_video
from codesign.events.volumes.surface import (
    decay,
    decay_from_stream,
    surface_from_counts,
    surface_from_stream,
)
from codesign.events.volumes.volume import from_counts, from_stream, spikes_from_stream

__all__ = [
    "LAYERS",
    "PRESETS",
    "ComparatorLayer",
    "EventLayer",
    "FastSigmoid",
    "HardSensor",
    "Laplace",
    "PhysicalLayer",
    "PhysicalState",
    "PositiveValues",
    "RecordedFrames",
    "SensorModel",
    "SensorState",
    "Settled",
    "SpikeEsim",
    "SpikeEsimState",
    "SrmState",
    "Triangular",
    "TwoBranchSpikes",
    "alpha_response",
    "concatenate",
    "count_loss",
    "decay",
    "decay_from_stream",
    "decay_video",
    "dense",
    "dense_counts",
    "draw_shot_counts",
    "draw_thresholds",
    "drive_scale",
    "expected",
    "finer",
    "from_counts",
    "from_stream",
    "gray_picture",
    "layer",
    "lin_log",
    "low_pass",
    "memory",
    "naive",
    "one_pole",
    "open_frames",
    "picture",
    "rates",
    "read",
    "read_frames",
    "sensor_counts",
    "simulate",
    "soft",
    "soft_counts",
    "spikes_from_stream",
    "srm",
    "surface_from_counts",
    "surface_from_stream",
    "to_counts",
    "upsample",
    "upsample_stream",
    "van_rossum",
    "write",
    "write_video",
]

explain(globals())
