"""The room of onnxruntime, as the box runs it. In: a model's bytes, a bundle, digits. Out: a session, its outputs.

Whatever onnxruntime raises comes out as a BundleError.
"""

from __future__ import annotations

from typing import Any

import onnxruntime as ort

from appliance.bundle.bundle import Bundle
from appliance.core.errors import BundleError
from appliance.signal import features


def session(model: bytes) -> ort.InferenceSession:
    """One thread, no spinning, errors only, telemetry off: a quiet session that leaves the core to the sensor."""
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
    """These outputs of the graph. Raises BundleError where onnxruntime cannot compute them."""
    try:
        gives: list[Any] = opened.run(outputs, given)
    except Exception as e:  # as above
        why = str(e).strip()[:200]
        raise BundleError(f"onnxruntime {ort.__version__} cannot run the model: {why}; export the bundle again") from e
    return gives


def check_signature(run: ort.InferenceSession, bundle: Bundle) -> str:
    """The name of the one input, after all shapes and types were compared with the manifest."""
    m, f = bundle.manifest, bundle.format
    if m.input == "raw":
        tensor = {
            "uint8": "tensor(uint8)",
            "int16": "tensor(int16)",
            "uint16": "tensor(uint16)",
            "float32": "tensor(float)",
        }
        want = [([1, f.window, f.rows, f.cols], tensor[f.dtype])]
    else:
        want = [([1, len(features.compute(m.input, bundle.golden[0], f.rate_hz))], "tensor(float)")]
    have = [(i.shape, i.type) for i in run.get_inputs()]
    if have != want:
        raise BundleError(f"the model takes {have}; the manifest asks for {want}")
    gives = {o.name: (o.shape, o.type) for o in run.get_outputs()}
    trained = len(m.labels) - len(bundle.enrolled)
    forms: dict[str, list[int | None]] = {  # None: any number
        "logits": [1, trained],
        "early": [1, len(m.early.least) if m.early else None, trained],
        "embedding": [1, bundle.classes.means.shape[1] if bundle.classes else None],
    }
    needed = {"logits"} | ({"early"} if m.early else set()) | ({"embedding"} if m.known else set())
    if not needed <= gives.keys() <= forms.keys() or not all(_fits(gives[name], forms[name]) for name in gives):
        raise BundleError(
            f"the model gives {gives}; the manifest asks for {', '.join(sorted(needed))} and allows "
            f"{forms} of tensor(float): export the bundle again"
        )
    name: str = run.get_inputs()[0].name
    return name


def _fits(has: tuple[list[Any], str], form: list[int | None]) -> bool:
    """Whether an output has this shape, None standing for any number."""
    shape, kind = has
    if kind != "tensor(float)" or len(shape) != len(form):
        return False
    return all(type(n) is int and n > 0 and want in (None, n) for n, want in zip(shape, form, strict=True))
