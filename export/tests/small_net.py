"""A network small enough for tests."""

import torch

from export.network import NetworkConfig, SuperSdfNet

SMALL = NetworkConfig(channels=8, blocks=2, hidden=16, functions=24, trunk=16, frequencies=2)


def small_net() -> SuperSdfNet:
    """Return a network away from the start, where the blocks do nothing."""
    torch.manual_seed(0)
    net = SuperSdfNet(SMALL)
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return net
