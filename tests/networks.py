"""A small image classifier, trained here in milliseconds, as an ONNX file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

SIZE_WH = (32, 32)
MEAN, SCALE = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
_CELLS = 4  # the network sees the mean colour of 4 x 4 cells


def footage(kind: str, seed: int, size_wh: tuple[int, int] = (160, 120)) -> NDArray[np.uint8]:
    """Return an image: a room in warm light, a sky over grass, or the same room in the dark."""
    rng = np.random.default_rng(seed)
    image = np.zeros((*size_wh[::-1], 3), np.float64)  # BGR
    horizon = int(size_wh[1] * rng.uniform(0.35, 0.65))
    if kind == "Outdoor":
        image[:horizon], image[horizon:] = (230, 190, 150), (50, 140, 70)
    else:
        image[:horizon], image[horizon:] = (140, 190, 220), (70, 100, 140)
    light = rng.uniform(0.7, 1.0) * (0.06 if kind == "Dark" else 1.0)
    noise = rng.normal(0, 6, image.shape)
    return cv2.blur(np.clip(image * light + noise, 0, 255).astype(np.uint8), (3, 3))


def write_network(path: Path, kinds: Sequence[str] = ("Indoor", "Outdoor", "Dark")) -> Path:
    """Train on 20 images of each kind, and write the network: RGB in, logits out."""
    onnx = pytest.importorskip("onnx", reason="onnx writes the network that is tested")
    images = [
        (footage(kind, seed), label) for label, kind in enumerate(kinds) for seed in range(20)
    ]
    inputs = np.array([_cells(image) for image, _ in images])
    truth = np.eye(len(kinds))[[label for _, label in images]]
    weights, bias = _fit(inputs, truth)
    from onnx import TensorProto, helper, numpy_helper

    width, height = SIZE_WH
    cell = [height // _CELLS, width // _CELLS]
    nodes = [
        helper.make_node("AveragePool", ["image"], ["cells"], kernel_shape=cell, strides=cell),
        helper.make_node("Flatten", ["cells"], ["flat"]),
        helper.make_node("Gemm", ["flat", "weights", "bias"], ["scores"]),
    ]
    graph = helper.make_graph(
        nodes,
        "scenes",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, height, width])],
        [helper.make_tensor_value_info("scores", TensorProto.FLOAT, [1, len(kinds)])],
        [
            numpy_helper.from_array(weights.astype(np.float32), "weights"),
            numpy_helper.from_array(bias.astype(np.float32), "bias"),
        ],
    )
    opsets = [helper.make_opsetid("", 13)]
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=8), str(path))
    return path


def _cells(image_bgr: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return what the network's first two layers make of an image."""
    small = cv2.resize(image_bgr, SIZE_WH, interpolation=cv2.INTER_AREA)[..., ::-1]
    pixels = ((small - np.array(MEAN)) / np.array(SCALE)).transpose(2, 0, 1)
    size = SIZE_WH[0] // _CELLS
    return pixels.reshape(3, _CELLS, size, _CELLS, size).mean(axis=(2, 4)).ravel()


def _fit(
    inputs: NDArray[np.float64], truth: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return weights and bias of a softmax regression, by gradient descent."""
    weights, bias = np.zeros((inputs.shape[1], truth.shape[1])), np.zeros(truth.shape[1])
    for _ in range(200):
        scores = inputs @ weights + bias
        shares = np.exp(scores - scores.max(axis=1, keepdims=True))
        error = shares / shares.sum(axis=1, keepdims=True) - truth
        weights -= 0.05 * inputs.T @ error / len(inputs)
        bias -= 0.05 * error.mean(axis=0)
    return weights, bias
