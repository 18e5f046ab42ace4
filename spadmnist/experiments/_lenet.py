"""LeNet, trained as the paper trains it: on images in memory, with one thread, so that every run is the same.

PyTorch is imported only where it is asked for.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import SpadError

if TYPE_CHECKING:
    import torch

EPOCHS = 10  # paper: 10 epochs ...
BATCH = 64  # ... with a batch size of 64 ...
RATE = 1e-3  # ... and Adam with a learning rate of 0.001
FILTERS = 6, 16  # LeNet-5: of 5 x 5, each layer followed by maxima over 2 x 2; the first one keeps the image's size
UNITS = 120, 84  # LeNet-5: of the layers behind them
CLASSES = 10
WORDS = (
    f"LeNet-5 with {FILTERS[0]} and {FILTERS[1]} filters of 5 x 5, maxima over 2 x 2, ReLU, and layers of {UNITS[0]}, "
    f"{UNITS[1]} and {CLASSES} units"
)
_TESTED = 250  # images that are classified at a time


def check_torch(name: str) -> None:
    """Raise SpadError, with what to install, where there is no PyTorch. name: of the experiment."""
    try:
        from .. import torch as _  # noqa: F401
    except ImportError as error:
        raise SpadError(f"{name}: {error}") from None


def network(side: tuple[int, int]) -> torch.nn.Module:
    """LeNet for images of (rows, columns); see `FILTERS` and `UNITS`. A layer's maxima come before its ReLU: the same
    numbers, and a quarter of the work.
    """
    import torch
    from torch import nn

    first, second = FILTERS
    layers: list[nn.Module] = [nn.Conv2d(1, first, 5, padding=2), nn.MaxPool2d(2), nn.ReLU()]
    layers += [nn.Conv2d(first, second, 5), nn.MaxPool2d(2), nn.ReLU(), nn.Flatten()]
    left = [(n // 2 - 4) // 2 for n in side]
    for inputs, outputs in pairwise((second * left[0] * left[1], *UNITS)):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    net = nn.Sequential(*layers, nn.Linear(UNITS[-1], CLASSES))
    return net.to(memory_format=torch.channels_last)


@dataclass(frozen=True)
class Labelled:
    """images: (n, rows, columns), float32, or uint8 where there are too many; labels: (n,), 0 to 9."""

    images: np.ndarray
    labels: np.ndarray


def train(
    data: Labelled, epochs: int, seed: int, after: Callable[[torch.nn.Module, int], Any] | None = None
) -> torch.nn.Module:
    """A network trained on all images, `epochs` times, in an order that `seed` decides, as do its first weights.

    It has the mean of the weights over the last epoch: with a learning rate that does not fall, the last step alone is
    one of a walk about it. after: called after each epoch with the network as it would be if that were the last, and
    the number of the epoch, from 1. The images are read by slices of one array.
    """
    with _alone(seed) as torch:
        images, labels = _tensors(data)
        net = network(data.images.shape[1:])
        mean = copy.deepcopy(net)
        weights, means = list(net.parameters()), list(mean.parameters())
        adam = torch.optim.Adam(weights, lr=RATE, fused=True)
        loss = torch.nn.CrossEntropyLoss()
        order = torch.Generator().manual_seed(seed)
        for epoch in range(1, epochs + 1):
            for step, chosen in enumerate(torch.randperm(len(labels), generator=order).split(BATCH), 1):
                adam.zero_grad()
                loss(net(images[chosen].float()), labels[chosen]).backward()
                adam.step()
                with torch.no_grad():
                    torch._foreach_lerp_(means, weights, 1 / step)
            if after is not None:
                after(mean, epoch)
    return mean


def accuracy(net: torch.nn.Module, data: Labelled) -> float:
    """The share of images to which a network gives the right label."""
    with _alone(0) as torch, torch.no_grad():
        images, labels = _tensors(data)
        pairs = zip(images.split(_TESTED), labels.split(_TESTED), strict=True)
        right = sum(int((net(some.float()).argmax(1) == true).sum()) for some, true in pairs)
    return right / len(data.labels)


def _tensors(data: Labelled) -> tuple[torch.Tensor, torch.Tensor]:
    import torch

    return torch.from_numpy(data.images)[:, None], torch.from_numpy(data.labels.astype(np.int64))


@contextlib.contextmanager
def _alone(seed: int) -> Iterator[Any]:
    """torch with one thread, whose sums come in one order, and random numbers of its own; both are put back."""
    import torch

    threads = torch.get_num_threads()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        torch.set_num_threads(1)
        try:
            yield torch
        finally:
            torch.set_num_threads(threads)
