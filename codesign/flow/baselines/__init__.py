"""Networks to compare event flow with: a plain convolutional one, one with a spiking encoder, a small evenly
cascaded one, and a recurrent one that deblurs. See docs/flow_baselines.md."""

from codesign.flow.baselines.ecn import ECN
from codesign.flow.baselines.flownet_events import FlowNetEvents
from codesign.flow.baselines.idnet import IDNet
from codesign.flow.baselines.parts import rescale_flow
from codesign.flow.baselines.spike_flownet import SpikeFlowNet, integrate_and_fire, to_halves

__all__ = [
    "ECN",
    "FlowNetEvents",
    "IDNet",
    "SpikeFlowNet",
    "integrate_and_fire",
    "rescale_flow",
    "to_halves",
]
