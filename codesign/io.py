"""Every file the toolkit reads and writes, in one place: lenses, event streams, event videos."""

from codesign.events import decay_video, write_video
from codesign.events import read as read_events
from codesign.events import write as write_events
from codesign.lens import load as load_lens
from codesign.lens import save as save_lens

__all__ = ["decay_video", "load_lens", "read_events", "save_lens", "write_events", "write_video"]
