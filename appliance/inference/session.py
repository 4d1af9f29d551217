"""Runs onnxruntime as the box does. In: the bytes of a model that onnx_check has accepted, and input arrays. Out: a
session and its outputs. Errors of onnxruntime become BundleErrors.
"""

from __future__ import annotations

from typing import Any

import onnxruntime as ort

from appliance.core.errors import BundleError


def session(model: bytes) -> ort.InferenceSession:
    """A session with one thread, no spinning, logging of errors only and no telemetry, since the sensor shares its
    core.

    Raises BundleError if onnxruntime refuses the model.
    """
    ort.disable_telemetry_events()
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    options.enable_cpu_mem_arena = False
    try:
        return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as e:  # onnxruntime raises its own classes, which share no base but Exception
        raise BundleError(f"onnxruntime {ort.__version__} refuses the model: {str(e).strip()[:200]}") from e


def run(opened: ort.InferenceSession, outputs: list[str], given: dict[str, Any]) -> list[Any]:
    """The graph's `outputs` for the input arrays `given` by name. Raises BundleError if they cannot be computed."""
    try:
        values: list[Any] = opened.run(outputs, given)
    except Exception as e:  # as above
        why = str(e).strip()[:200]
        raise BundleError(f"onnxruntime {ort.__version__} cannot run the model: {why}; export the bundle again") from e
    return values
