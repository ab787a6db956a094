"""Independently computed values of every formula, as tensors of either precision."""

import json
from pathlib import Path
from typing import Any

import torch as th

GOLDEN: dict[str, Any] = json.loads((Path(__file__).parent / "golden.json").read_text())
TOLERANCE = {th.float64: 1e-9, th.float32: 1e-5}


def golden(name: str, dtype: th.dtype) -> dict[str, Any]:
    """The case ``name``; lists become tensors."""
    return {key: th.tensor(value, dtype=dtype) if isinstance(value, list) else value for key, value in GOLDEN[name].items()}


def assert_close(actual: th.Tensor, expected: Any) -> None:
    tolerance = TOLERANCE[actual.dtype]
    expected = th.as_tensor(expected, dtype=actual.dtype)
    th.testing.assert_close(actual, expected, rtol=tolerance * 10, atol=tolerance * 10)
