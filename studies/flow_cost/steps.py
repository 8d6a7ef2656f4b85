"""The spiking baseline computed as its form is written down, to tell what computing it otherwise gains."""

import torch
from torch.nn.functional import leaky_relu

from codesign.flow.baselines import SpikeFlowNet, rescale_flow


class StepByStep(SpikeFlowNet):
    """SpikeFlowNet with all layers in each time step, neurons of plain tensors, and every neck and head a
    layer of its own. Same flow; forward only."""

    def __init__(self, **sizes):
        super().__init__(**sizes)
        self.to(memory_format=torch.contiguous_format)  # pyright: ignore[reportCallIssue]

    def encode(self, halves):
        potential = [0.0] * 4
        sums = [0.0] * 4
        for t in range(halves.shape[4]):
            x = halves[..., t]
            for i, layer in enumerate(self.encoder):
                current = layer(x)
                potential[i] = potential[i] + current
                sums[i] = sums[i] + current
                x = (potential[i] >= self.config["threshold"]).to(current)
                potential[i] = potential[i] * (1 - x)
        return sums

    def decode(self, sums):
        x = sums[-1]
        flows = []
        for first, second in self.residual:  # pyright: ignore[reportGeneralTypeIssues]
            x = x + leaky_relu(second(leaky_relu(first(x), 0.1)), 0.1)
        for level in range(4):
            change = self.heads[level](self.necks[level](x))
            flows.append(rescale_flow(flows[-1], change.shape[2:]) + change if flows else change)
            if level < 3:
                x = torch.cat([sums[2 - level], leaky_relu(self.decoder[level](x), 0.1), flows[-1]], 1)
        return flows
