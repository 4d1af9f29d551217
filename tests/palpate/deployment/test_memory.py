"""Memory: the limit of the service is above the memory of any bundle that the box accepts."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest

from palpate.bundle import bundle
from palpate.deployment.sandbox import run_limited
from palpate.inference.session import try_all
from tests.factories import toy_bundle
from tests.factories.paths import ROOT

MEASURE = """
import sys
from pathlib import Path
from palpate.bundle import bundle
from palpate.cli.common import load_bundle, load_settings
from palpate.core.clock import SystemClock
from palpate.deployment.store import Store
from palpate.inference.classifier import Classifier
import palpate.runtime.loop, palpate.runtime.assembly, palpate.cli.run_command
made = bundle.load(Path(sys.argv[1]))
run = Classifier(made, SystemClock())
for golden in made.golden:
    run.logits(golden)
status = open("/proc/self/status")
print(next(line.split()[1] for line in status if line.startswith("VmHWM")))
"""


@pytest.mark.slow
def test_a_bundle_near_the_limit_leaves_the_service_alive(tmp_path):
    """The program runs a bundle near the largest that its trial admits, below the unit's limit."""

    def large(numbers: int) -> dict[str, bytes]:
        """The files of the toy bundle with two large matrices in its model."""
        onnx = pytest.importorskip("onnx")
        model = onnx.load_from_string(toy_bundle.model(("logits",)))
        rng = np.random.default_rng(1)
        for name, shape in (("wide", (3, numbers)), ("back", (numbers, 3))):
            model.graph.initializer.append(
                onnx.numpy_helper.from_array(rng.normal(size=shape).astype(np.float32), name)
            )
        product = onnx.helper.make_node
        last = next(node for node in model.graph.node if "logits" in node.output)
        last.output[0] = "small"
        after = [
            product("MatMul", ["small", "wide"], ["large"]),
            product("MatMul", ["large", "back"], ["logits"]),
        ]
        kept = [node for node in model.graph.node if not {"row", "early"} & set(node.output)]
        del model.graph.node[:]
        model.graph.node.extend([*kept, *after])
        files = toy_bundle.files(known=None, outputs=("logits",)) | {
            bundle.MODEL: model.SerializeToString()
        }
        manifest = bundle.Manifest.parse(files[bundle.MANIFEST])
        entries = manifest.files | {bundle.MODEL: bundle.file_entry(files[bundle.MODEL])}
        return files | {bundle.MANIFEST: toy_bundle.replace(manifest, files=entries).json()}

    def limit() -> int:
        """The service's limit in its unit, in bytes."""
        unit = (ROOT / "systemd" / "palpate.service").read_text()
        (most,) = re.findall(r"^MemoryMax=(\d+)M$", unit, re.MULTILINE)
        return int(most) << 20

    folder = toy_bundle.put(tmp_path / "large", large(1_400_000))
    made = bundle.load(folder)
    run_limited(lambda: try_all(made))
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, folder],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) * 1024 < limit()
