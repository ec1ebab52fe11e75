"""Learning from annotated pictures, and how well each way of learning does on pictures it has not seen.

Three ways are measured side by side: a support vector machine on the paper's three variables, one on all features,
and the nearest taught views, which alone can say that a part is none of the classes.

Source: Cortes and Vapnik, "Support-vector networks", Machine Learning 20, 1995 (OpenCV's implementation).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from controller.vision.classes.classifier import Classifier

Floats32 = NDArray[np.float32]
FOLDS = 5
_C = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """Annotated objects.

    Attributes:
        labels: Class of each.
        pictures: File each was seen in: all of a picture is learnt from or tested, never both.
        paper: ndarray of shape (n, 3): extent, compactness, side difference over the root of the area.
        features: ndarray of shape (n, features.LENGTH).
    """

    labels: tuple[str, ...]
    pictures: tuple[str, ...]
    paper: Floats32
    features: Floats32


def cross_validated(examples: Examples) -> dict[str, list[str]]:
    """What each way of learning says of every example when its picture's fold is left out; `unknown` for none."""
    order = {name: k for k, name in enumerate(dict.fromkeys(examples.pictures))}
    fold = np.array([order[name] % FOLDS for name in examples.pictures])
    labels = np.array(examples.labels)
    ways: dict[str, tuple[Floats32, Callable[[Floats32, NDArray[np.str_], Floats32], list[str]]]] = {
        "svm_paper": (examples.paper, _svm),
        "svm_features": (examples.features, _svm),
        "nearest_views": (examples.features, _nearest),
    }
    said: dict[str, list[str]] = {}
    for name, (values, learn) in ways.items():
        out = np.full(len(labels), "unknown", dtype=object)
        for k in np.unique(fold):
            seen, new = fold != k, fold == k
            if seen.any():
                out[new] = learn(values[seen], labels[seen], values[new])
        said[name] = [str(value) for value in out]
    return said


def _svm(values: Floats32, labels: NDArray[np.str_], new: Floats32) -> list[str]:
    """Labels of new examples by a support vector machine with a Gaussian kernel as wide as the features are many."""
    names, numbers = np.unique(labels, return_inverse=True)
    if len(names) == 1:
        return [str(names[0])] * len(new)
    mean, scale = values.mean(axis=0), values.std(axis=0) + np.float32(1e-6)
    machine = cv2.ml.SVM.create()
    machine.setType(cv2.ml.SVM_C_SVC)
    machine.setKernel(cv2.ml.SVM_RBF)
    machine.setC(_C)
    machine.setGamma(1.0 / values.shape[1])
    machine.train((values - mean) / scale, cv2.ml.ROW_SAMPLE, numbers.astype(np.int32))
    _, found = machine.predict((new - mean) / scale)
    return [str(names[int(k)]) for k in found[:, 0]]


def _nearest(values: Floats32, labels: NDArray[np.str_], new: Floats32) -> list[str]:
    views = {str(name): values[labels == name] for name in np.unique(labels)}
    return [v.name if v is not None and v.name is not None else "unknown" for v in Classifier(views).verdicts(new)]


def by_class(labels: Sequence[str], said: Sequence[str]) -> dict[str, dict[str, int]]:
    """Confusion: for each class how often it was said to be what."""
    table: dict[str, dict[str, int]] = {}
    for true, name in zip(labels, said, strict=True):
        row = table.setdefault(true, {})
        row[name] = row.get(name, 0) + 1
    return table
