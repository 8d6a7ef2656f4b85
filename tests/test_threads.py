"""Threads that compute gradients at once give what one after the other gives; what was forked says
what to do."""

import os

import pytest

from tests.processes import ROOT, python

FORKED = """
import os, torch
from codesign import lens, render
from codesign.exclusive import exclusive
camera = render.Camera(lens.load("cooke-triplet").scaled(0.22), 4, 4, 0.2, 4)
camera.rays()
child = os.fork()
if child == 0:
    try:
        with exclusive:
            pass
    except Exception as error:
        os._exit(7 if "spawn" in str(error) else 1)
    os._exit(2)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


FIRST = """
import threading
{}
from codesign import lens
lens.load("cooke-triplet", torch.float32).trace(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]))
print([each.name for each in threading.enumerate()])
"""


WORKERS = """
import sys, torch
from torch.utils.data import DataLoader
from tests.hostile.threads import estimated

class Made(torch.utils.data.Dataset):
    def __len__(self): return 2
    def __getitem__(self, k): return torch.cat([each.double().reshape(-1) for each in estimated(k)])

def loaded():
    workers = DataLoader(Made(), batch_size=None, num_workers=2, multiprocessing_context=sys.argv[1])
    return torch.cat(list(workers))

if __name__ == "__main__":
    early = loaded() if sys.argv[1] == "fork" else None  # before the first kernel of this process
    serial = torch.cat([Made()[k] for k in range(2)])
    print(float(((early if early is not None else loaded()) - serial).abs().max()))
"""


def test_many_threads_with_gradients_equal_serial_ones():
    kinds = "('traced', 'estimated', 'counted')"
    script = f"from tests.hostile.threads import *; k = {kinds}; found = run(8, 1, k); print(max(found[n] for n in k))"
    done = python("-c", script)
    assert done.returncode == 0, done.stderr[-2000:]
    # sums of doubles, in an order that drjit's own threads choose
    assert float(done.stdout) < 1e-9


def test_a_process_forked_after_the_first_kernel_is_told_to_spawn():
    done = python("-c", FORKED)
    assert done.stdout.strip() == "7", done.stderr[-2000:]


@pytest.mark.skipif(os.cpu_count() == 1, reason="one core has no thread to wait")
@pytest.mark.parametrize(
    ("imports", "held"), [("import torch", True), ("import codesign, torch", False)]
)
def test_threads_of_a_torch_that_came_first_are_kept_from_spinning(imports, held, monkeypatch):
    for name in ("OMP_WAIT_POLICY", "OMP_NUM_THREADS"):  # as on a machine that nobody has set up
        monkeypatch.delenv(name, raising=False)
    done = python("-c", FIRST.format(imports))
    assert done.returncode == 0, done.stderr[-2000:]
    assert ("codesign-waiting" in done.stdout) == held


@pytest.mark.parametrize("context", ["spawn", "fork"])
def test_workers_of_a_loader_with_gradients_equal_serial_work(context, tmp_path):
    script = tmp_path / "workers.py"
    script.write_text(WORKERS)
    done = python(script, context, PYTHONPATH=str(ROOT))
    assert done.returncode == 0, done.stderr[-2000:]
    assert float(done.stdout) < 1e-9
