"""The one place that decides in which mode networks with dropout or batch norm compute.

A network that a loss trains is in training mode. A policy that acts, and whatever a loss computes
without gradients, such as targets, is a copy of it in evaluation mode.
"""

from __future__ import annotations

import copy
from typing import TypeVar

from tensordict import TensorDictParams
from torch import nn

Network = TypeVar("Network", bound=nn.Module)


def evaluation_copy(network: Network) -> Network:
    """Return a copy of a network in evaluation mode, with the same parameters and buffers.

    The copy computes with the latest parameters and statistics and changes neither, in whichever
    mode the network is. A tensor that is neither a parameter nor a buffer is copied.

    Examples:
        >>> import torch
        >>> from ba_torchrl.modules import evaluation_copy
        >>> network = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Dropout(0.5))
        >>> acting = evaluation_copy(network)
        >>> acting.training, network.training, acting[0].weight is network[0].weight
        (False, True, True)
    """
    params = (part for part in network.modules() if isinstance(part, TensorDictParams))
    kept = (*network.parameters(), *network.buffers(), *params)
    return set_evaluation_mode(copy.deepcopy(network, {id(each): each for each in kept}))


def set_evaluation_mode(network: Network) -> Network:
    """Set a network to evaluation mode and return it.

    Convolutions of escnn stay in training mode, which changes nothing but that they expand their
    filters in each pass: in evaluation mode they keep the filters of the weights at this moment.
    """
    if not hasattr(network, "expand_parameters"):
        network.training = False
        for child in network.children():
            set_evaluation_mode(child)
    return network
