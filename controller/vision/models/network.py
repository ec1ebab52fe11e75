"""A trained model loaded and checked against what its recipe declares, and run.

A model is refused before it names anything when the file is missing, too large, not the one whose checksum the recipe
states, not a network, or when what comes out of it has another shape than declared.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.config.files import shipped
from controller.errors import ConfigError
from controller.vision.models.settings import MOST_BYTES, Model

Floats32 = NDArray[np.float32]
Image = NDArray[np.uint8]


class Network:
    """One loaded model; calls from several threads wait for one another.

    Args:
        settings: What the recipe says about it.
        run: Gives the output (n, ...) of an input (n, C, H, W).
    """

    def __init__(self, settings: Model, run: Callable[[Floats32], Floats32]) -> None:
        self.settings = settings
        self._run = run
        self._lock = threading.Lock()

    def scores(self, images: Image) -> Floats32:
        """The output for pictures (n, height, width, 3) of the input's size, BGR; rows of a classifier sum to 1.

        Raises:
            ConfigError: The network fails, or gives something of another shape than declared, or not numbers.
        """
        settings = self.settings
        batch = _blob(images, settings)
        at_once = settings.input[0] or max(len(batch), 1)
        with self._lock:
            parts = [self._one(batch[k : k + at_once], at_once) for k in range(0, len(batch), at_once)]
        if settings.task == "detect":
            return parts[0]
        out = np.concatenate(parts) if parts else np.empty((0, len(settings.labels)), np.float32)
        if settings.values == "logits":
            powers = np.exp(out - out.max(axis=1, keepdims=True))
            out = powers / powers.sum(axis=1, keepdims=True)
        return np.asarray(out, np.float32)

    def _one(self, batch: Floats32, at_once: int) -> Floats32:
        settings = self.settings
        count = len(batch)
        if count < at_once:
            batch = np.concatenate([batch, np.zeros((at_once - count, *batch.shape[1:]), np.float32)])
        try:
            out = np.asarray(self._run(batch), np.float32)
        except (cv2.error, RuntimeError, ValueError) as error:
            raise ConfigError(
                f"{settings.file} cannot take {list(batch.shape)}: {_short(error)}", "mend `input` in the recipe"
            ) from error
        # Free places of the shape: how many pictures there are, or how many boxes.
        fits = out.ndim == len(settings.output) and all(
            declared in (0, found) or (place == 0 and found == at_once)
            for place, (declared, found) in enumerate(zip(settings.output, out.shape, strict=True))
        )
        if not fits:
            raise ConfigError(
                f"{settings.file} gives {list(out.shape)}, the recipe says {list(settings.output)}",
                "mend `output`, or take the model that belongs to the recipe",
            )
        if not np.isfinite(out).all():
            raise ConfigError(f"{settings.file} gives values that are no numbers", "take another model")
        return out[:count]


def model_file(name: str) -> Path:
    """The shipped model of that name, else the path as given.

    Raises:
        ConfigError: There is no such file.
    """
    folder = shipped("models")
    if (folder / name).is_file() and Path(name).name == name:
        return folder / name
    path = Path(name)
    if path.is_file():
        return path
    names = ", ".join(sorted(p.name for p in folder.glob("*.onnx")))
    raise ConfigError(f"{name}: no such file and not one of the shipped models", f"use {names}, or name a file")


@lru_cache(maxsize=4)
def network(settings: Model) -> Network:
    """The network that a recipe declares, loaded once and tried on an empty picture.

    Raises:
        ConfigError: See the module.
    """
    path = model_file(settings.file)
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ConfigError(f"{path} is larger than {MOST_BYTES // 1_000_000} MB", "take a smaller model")
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror})", "name a file that can be read") from error
    found = hashlib.sha256(data).hexdigest()
    if found != settings.sha256:
        raise ConfigError(
            f"{path} is not the model of the recipe: its sha256 is {found}", "take that model, or state its checksum"
        )
    run = _in_opencv(path, data) if settings.runtime == "opencv" else _in_onnxruntime(path, data)
    made = Network(settings, run)
    _, _, height, width = settings.input
    made.scores(np.zeros((settings.input[0] or 1, height, width, 3), np.uint8))
    return made


def _in_opencv(path: Path, data: bytes) -> Callable[[Floats32], Floats32]:
    try:
        net = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
    except cv2.error as error:
        raise ConfigError(
            f"{path} is no network that OpenCV can read: {_short(error)}", 'try runtime = "onnxruntime"'
        ) from error

    def run(batch: Floats32) -> Floats32:
        net.setInput(batch)
        return np.asarray(net.forward(), np.float32)

    return run


def _in_onnxruntime(path: Path, data: bytes) -> Callable[[Floats32], Floats32]:
    try:
        import onnxruntime
    except ImportError as error:
        raise ConfigError(
            f"{path} asks for onnxruntime, which is not installed", "pip install 'sorting-controller[onnx]'"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors share no base class of their own
        raise ConfigError(f"{path} is no network that onnxruntime can read: {_short(error)}", "mend it") from error
    name = session.get_inputs()[0].name

    def run(batch: Floats32) -> Floats32:
        try:
            return np.asarray(session.run(None, {name: batch})[0], np.float32)
        except Exception as error:  # see above
            raise RuntimeError(_short(error)) from error

    return run


def _blob(images: Image, settings: Model) -> Floats32:
    """(n, C, H, W) values of pictures (n, H, W, 3)."""
    channels = settings.input[1]
    if channels == 1:
        gray = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
        values = np.asarray(gray, np.float32).reshape(len(images), *images.shape[1:3], 1)
    else:
        values = images[..., ::-1 if settings.colours == "rgb" else 1].astype(np.float32)
    values = (values - np.array(settings.mean[:channels], np.float32)) * np.float32(settings.scale)
    return np.ascontiguousarray(values.transpose(0, 3, 1, 2))


def _short(error: Exception) -> str:
    """The telling line of a library's message."""
    text = " ".join(str(error).split())
    marker = "error: "
    text = text[text.find(marker) + len(marker) :] if marker in text else text
    return text if len(text) <= 160 else text[:157] + "..."
