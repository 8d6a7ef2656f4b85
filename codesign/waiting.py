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

    Its OpenMP, libgomp, lets threads sleep soon when there are more of them than cores: so other
    teams of them are held, which do nothing. Asked once, of as many threads as torch has then.
    """
    if not CAME_LATE:
        return
    import torch

    team, cores = torch.get_num_threads(), os.cpu_count() or 1
    if team == 1 or 4 * team <= cores:  # none waits, or there are cores enough to wait on
        return
    begun = threading.Semaphore(0)

    def hold():
        try:
            torch.ones(1 << 20).sum()
        finally:
            begun.release()
        threading.Event().wait()

    for _ in range(held := cores // team):
        threading.Thread(target=hold, name="codesign-waiting", daemon=True).start()
    for _ in range(held):
        begun.acquire()
