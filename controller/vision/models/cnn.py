"""A small convolutional network for crops of parts: learnt with PyTorch (extra `train`), written as ONNX.

Four layers of 3 x 3 kernels, each halving the picture, then a mean over what remains: 80 000 weights. Nothing here is
needed to use a model; `network.py` runs it without PyTorch.

Source: layer normalisation over batches: Ioffe and Szegedy, 2015; the one-cycle schedule: Smith and Topin, 2018.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import io
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.errors import InputError
from controller.vision.models.settings import Model

Image = NDArray[np.uint8]

SIDE = 48
"""Height and width of a crop, px."""
MARGIN = 1.15
"""Side of a crop over the diameter of the circle around the part."""
_WIDTHS = (16, 32, 64, 96)
_BATCH = 128
_FASTEST = 0.01
_OPSET = 13


def learnt(
    images: Image,
    labels: NDArray[np.int64],
    names: Sequence[str],
    *,
    epochs: int,
    seed: int,
    say: Callable[[str], None] = lambda line: None,
) -> bytes:
    """The ONNX file of a network learnt from crops.

    Args:
        images: ndarray of shape (n, SIDE, SIDE, 3), dtype uint8, BGR.
        labels: ndarray of shape (n,): indices into `names`.
        names: The classes.
        epochs: How often every crop is shown, each time turned and mirrored anew.
        seed: Of weights and order.
        say: Told of the progress, a line an epoch.

    Raises:
        InputError: PyTorch or onnx is not installed.
    """
    torch = _torch()
    torch.manual_seed(seed)
    net = _network(torch, len(names))
    values = torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2)))
    wanted = torch.from_numpy(labels)
    steps = math.ceil(len(labels) / _BATCH)
    optimiser = torch.optim.AdamW(net.parameters(), lr=_FASTEST / 10.0, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _FASTEST, total_steps=epochs * steps)
    # Classes with few examples count as much as those with many.
    share = np.bincount(labels, minlength=len(names)) / len(labels)
    weight = torch.tensor(np.minimum(1.0 / np.maximum(share * len(names), 1e-3), 10.0), dtype=torch.float32)
    loss_of = torch.nn.CrossEntropyLoss(weight=weight, label_smoothing=0.03)
    random = np.random.default_rng([seed, 22])
    for epoch in range(epochs):
        net.train()
        total = 0.0
        for some in np.array_split(random.permutation(len(labels)), steps):
            chosen = torch.from_numpy(some)
            batch = _turned(torch, values[chosen].float() / 255.0, random)
            loss = loss_of(net(batch), wanted[chosen])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            total += loss.item() * len(some)
        say(f"epoch {epoch + 1} of {epochs}: loss {total / len(labels):.4f}")
    net.eval()
    return _exported(torch, torch.nn.Sequential(net, torch.nn.Softmax(dim=1)))


def settings_for(file: str, data: bytes, names: Sequence[str]) -> Model:
    """What a recipe has to say of a network that `learnt` made."""
    return Model(
        file=file,
        sha256=hashlib.sha256(data).hexdigest(),
        input=(1, 3, SIDE, SIDE),
        output=(1, len(names)),
        labels=tuple(names),
        colours="bgr",
        margin=MARGIN,
    )


def _network(torch: Any, classes: int) -> Any:
    nn = torch.nn
    layers: list[Any] = []
    before = 3
    for wide in _WIDTHS:
        layers += [nn.Conv2d(before, wide, 3, padding=1, bias=False), nn.BatchNorm2d(wide), nn.ReLU(), nn.MaxPool2d(2)]
        before = wide
    # The first layer would cost as much as all others: it looks at every second pixel only, in larger kernels.
    layers[0] = nn.Conv2d(3, _WIDTHS[0], 5, stride=2, padding=2, bias=False)
    del layers[3]
    return nn.Sequential(*layers, nn.AvgPool2d(SIDE // 2 ** len(_WIDTHS)), nn.Flatten(), nn.Linear(before, classes))


def _turned(torch: Any, batch: Any, random: np.random.Generator) -> Any:
    """The batch turned by a multiple of 90 degrees, mirrored or not, a little lighter or darker, in other colours."""
    batch = torch.rot90(batch, int(random.integers(4)), (2, 3))
    if random.random() < 0.5:
        batch = batch.flip(3)
    gain = torch.from_numpy(random.uniform(0.7, 1.3, (len(batch), 1, 1, 1)).astype(np.float32))
    order = torch.from_numpy(random.permutation(3))
    return (batch[:, order] * gain).clamp(0.0, 1.0)


def _exported(torch: Any, net: Any) -> bytes:
    buffer = io.BytesIO()
    example = torch.zeros(1, 3, SIDE, SIDE)
    # The exporter by tracing: the other one needs more packages and writes operators that OpenCV does not know.
    torch.onnx.export(
        net, (example,), buffer, input_names=["crop"], output_names=["shares"], opset_version=_OPSET, dynamo=False
    )
    return buffer.getvalue()


def _torch() -> Any:
    # The exporter needs onnx at the very end: better known before.
    missing = [name for name in ("torch", "onnx") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"learning a network needs {' and '.join(missing)}",
            "install the extra: pip install 'sorting-controller[train]'",
        )
    return importlib.import_module("torch")
