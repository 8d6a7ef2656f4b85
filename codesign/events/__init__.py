"""Events: from frames to event counts, streams and volumes."""

from codesign.events.intensity import lin_log
from codesign.events.memory import memory, soft_counts
from codesign.events.volume import from_counts, from_stream

__all__ = ["from_counts", "from_stream", "lin_log", "memory", "soft_counts"]
