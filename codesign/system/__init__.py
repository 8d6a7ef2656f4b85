"""One system of camera, mount, event layer and estimator, with a probe at every junction."""

from codesign.doors import explain
from codesign.system.batch import Batch
from codesign.system.check import check
from codesign.system.hand_over import HandOver, load_hand_over, save_hand_over
from codesign.system.result import JUNCTIONS, Result
from codesign.system.system import System

__all__ = [
    "JUNCTIONS",
    "Batch",
    "HandOver",
    "Result",
    "System",
    "check",
    "load_hand_over",
    "save_hand_over",
]

explain(globals())
