"""Event flow: the closed form, the refiner and the networks it is compared with, losses, error
measures, network files, flow files, sources of windows, and flow along a stream of events."""

from codesign.doors import explain
from codesign.flow import contrast, losses, metrics, sources
from codesign.flow.baselines import FlowNetEvents, SpikeFlowNet
from codesign.flow.checkpoint import load, save
from codesign.flow.choice import estimate
from codesign.flow.export import export
from codesign.flow.files import read_flow, write_flow
from codesign.flow.lk import estimate_lk
from codesign.flow.refiner import Refiner
from codesign.flow.tracker import TrackedWindow, Tracker

__all__ = [
    "FlowNetEvents",
    "Refiner",
    "SpikeFlowNet",
    "TrackedWindow",
    "Tracker",
    "contrast",
    "estimate",
    "estimate_lk",
    "export",
    "load",
    "losses",
    "metrics",
    "read_flow",
    "save",
    "sources",
    "write_flow",
]

explain(globals())
