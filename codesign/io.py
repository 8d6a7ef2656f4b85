"""Every file the toolkit reads and writes, in one place: lenses, event streams, event videos, optical
flow."""

from codesign.events import decay_video, write_video
from codesign.events import read as read_events
from codesign.events import write as write_events
from codesign.flow_files import read_flow, write_flow
from codesign.lens import load as load_lens
from codesign.lens import save as save_lens

__all__ = [
    "decay_video",
    "load_lens",
    "read_events",
    "read_flow",
    "save_lens",
    "write_events",
    "write_flow",
    "write_video",
]
