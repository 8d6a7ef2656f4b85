"""Networks to compare event flow with: a plain convolutional one, and one with a spiking encoder.
See docs/flow_baselines.md."""

from codesign.flow.baselines.flownet_events import FlowNetEvents
from codesign.flow.baselines.spike_flownet import SpikeFlowNet

__all__ = ["FlowNetEvents", "SpikeFlowNet"]
