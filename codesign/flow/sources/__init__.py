"""Where flow is learned from and judged on: recordings with true flow by path, and folders of data
sets as sources of windows."""

from codesign.doors import explain
from codesign.flow.sources.dsec import DsecWindows
from codesign.flow.sources.mvsec import MvsecWindows
from codesign.flow.sources.packet import SKIPPABLE, Packet, PacketOptions
from codesign.flow.sources.packets import read_packets, read_recording
from codesign.flow.sources.recorded import RecordingWindows, open_windows
from codesign.flow.sources.rendered import DatasetWindows

__all__ = [
    "SKIPPABLE",
    "DatasetWindows",
    "DsecWindows",
    "MvsecWindows",
    "Packet",
    "PacketOptions",
    "RecordingWindows",
    "open_windows",
    "read_packets",
    "read_recording",
]

explain(globals())
