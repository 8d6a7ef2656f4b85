"""How torch's threads wait.

Torch's OpenMP threads would busy-wait after each operation on the core that drjit's thread pool
needs: a render step took 2 times the processor time, flow 2.4 times the time by the clock.
"""

import os
import sys
import threading
from functools import lru_cache

# torch reads this when it is imported
CAME_LATE = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


@lru_cache(maxsize=1)
def threads_sleep() -> None:
    """See to it where torch was imported before codesign too.

    Its OpenMP, libgomp, lets threads sleep soon when there are more of them than cores: so another
    team of them is held, which does nothing.
    """
    if not CAME_LATE:
        return
    import torch

    begun = threading.Event()

    def hold():
        torch.ones(1 << 20).sum()
        begun.set()
        threading.Event().wait()

    threading.Thread(target=hold, name="codesign-waiting", daemon=True).start()
    begun.wait()
