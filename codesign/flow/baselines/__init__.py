"""Networks to compare event flow with: a plain convolutional one and one with a spiking encoder. See
docs/flow_baselines.md."""

from codesign.flow.baselines.flownet_events import FlowNetEvents
from codesign.flow.baselines.halves import from_halves, to_halves
from codesign.flow.baselines.neuron import integrate_and_fire
from codesign.flow.baselines.rescale import rescale_flow
from codesign.flow.baselines.spike_flownet import SpikeFlowNet

__all__ = ["FlowNetEvents", "SpikeFlowNet", "from_halves", "integrate_and_fire", "rescale_flow", "to_halves"]
