"""Other processors: the same bundle gives the same labels on x86 with and without VNNI, and on
arm64.

qemu emulates them, instruction by instruction. PALPATE_MACHINES=1 gets the tools for that (see
tests/rig/emulated_machines.py) and fails without them; otherwise tests without their tools
are skipped.
"""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from palpate.answer.objects import softmax
from palpate.bundle import bundle
from palpate_train.data import sets
from palpate_train.export import quantized_bundle
from palpate_train.onnx_tools.graph_builder import TENSOR
from tests.factories.sweep_sets import easy
from tests.factories.trained_stages import with_stages
from tests.rig import emulated_machines

pytestmark = [pytest.mark.slow, pytest.mark.thorough]  # emulated processors

EIGHT_BITS = "eight bits"
INSIDE = ("default", "int16")
SHOWN_SWEEPS = 8
WINDOWS = int(os.environ.get("PALPATE_WINDOWS", "0"))
"""New windows for each bundle; 0 for the few that it was judged by."""
LIMIT_S = 300 + WINDOWS


@pytest.fixture(scope="session")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default bundle, a fresh bundle for each type of raw counts, a network that overflows."""
    if os.environ.get("PALPATE_MACHINES") == "1":
        emulated_machines.set_up()
    folder = tmp_path_factory.mktemp("given")
    shutil.copytree(bundle.DEFAULT, folder / "default")
    slides = sets.load(f"sim:T-REAL:1001:{1 + WINDOWS // 54}").samples
    np.save(folder / "default" / "sweeps.npy", slides[:WINDOWS] if WINDOWS else slides[::3])
    for dtype in TENSOR:
        fitted = with_stages(easy(dtype=dtype))
        quantized_bundle.export(fitted, folder / dtype, dtype, "1", "")
        new = easy(WINDOWS // 3 + 1, dtype=dtype, seed=7).samples[:WINDOWS]
        np.save(folder / dtype / "sweeps.npy", new if WINDOWS else fitted.held.samples)
    for name in INSIDE:
        _show(folder, name)
    overflowing(folder / EIGHT_BITS)
    return folder


def _show(folder: Path, name: str) -> None:
    """Add a folder with the same graph, whose outputs are its int8 tensors."""
    model = onnx.load(folder / name / bundle.MODEL)
    del model.graph.output[:]
    (folder / f"{name} inside").mkdir()
    names = [node.output[0] for node in model.graph.node if node.op_type == "QuantizeLinear"]
    model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in dict.fromkeys(names))
    (folder / f"{name} inside" / "shown.onnx").write_bytes(model.SerializeToString())
    np.save(
        folder / f"{name} inside" / "sweeps.npy",
        np.load(folder / name / "sweeps.npy")[:SHOWN_SWEEPS],
    )


def overflowing(folder: Path) -> None:
    """A convolution over bytes at their maximum: two of its products overflow 16 bits."""
    folder.mkdir()
    taps = np.full((32, 32, 5), 127, np.int8)
    constants = {
        "one": np.float32(1),
        "none": np.uint8(0),
        "none8": np.int8(0),
        "much": np.float32(2**15),
        "taps": taps,
    }
    nodes = [
        helper.make_node("DequantizeLinear", ["sweep", "one", "none"], ["x"]),
        helper.make_node("DequantizeLinear", ["taps", "one", "none8"], ["w"]),
        helper.make_node("Conv", ["x", "w"], ["y"]),
        helper.make_node("QuantizeLinear", ["y", "much", "none"], ["q"]),
        helper.make_node("DequantizeLinear", ["q", "much", "none"], ["z"]),
    ]
    graph = helper.make_graph(
        nodes,
        "overflowing",
        [helper.make_tensor_value_info("sweep", TensorProto.UINT8, [1, 32, 64])],
        [helper.make_tensor_value_info("q", TensorProto.UINT8, None)],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    (folder / "shown.onnx").write_bytes(model.SerializeToString())
    np.save(folder / "sweeps.npy", np.full((1, 32, 64), 255, np.uint8))


@pytest.fixture(scope="session")
def here(given: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """The outputs of this machine."""
    results_file = tmp_path_factory.mktemp("here") / "results.npz"
    emulated_machines.work(given, results_file)
    with np.load(results_file) as z:
        return dict(z)


@pytest.fixture(scope="session", params=emulated_machines.MACHINES)
def there(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, dict[str, np.ndarray]]:
    """A machine's name, and its outputs."""
    insist = os.environ.get("PALPATE_MACHINES") == "1"
    results_file = tmp_path_factory.mktemp("there") / "results.npz"
    try:
        if insist:
            emulated_machines.set_up()
        emulated_machines.command(request.param)
    except emulated_machines.Missing as e:
        (pytest.fail if insist else pytest.skip)(str(e))
    args, env = emulated_machines.command(
        request.param, request.getfixturevalue("given"), results_file
    )
    done = subprocess.run(
        args, env=env, capture_output=True, text=True, check=False, timeout=LIMIT_S
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with np.load(results_file) as z:
        return request.param, dict(z)


def test_a_bundle_says_the_same_on_every_machine(
    here: dict[str, np.ndarray], there: tuple[str, dict[str, np.ndarray]]
):
    """The same labels, and probabilities within the tolerance of the box's self test."""
    name, there_result = there
    assert there_result.keys() == here.keys()
    for what in here:
        if not what.endswith(("/golden", "/sweeps")):
            continue
        apart = np.abs(softmax(there_result[what]) - softmax(here[what])).max()
        print(
            f"{name}: {what}: {len(here[what])} sweeps, probabilities {apart:.2g} apart, "
            f"logits {np.abs(there_result[what] - here[what]).max():.2g}"
        )
        np.testing.assert_array_equal(there_result[what].argmax(1), here[what].argmax(1))
        assert apart <= bundle.GOLDEN_TOLERANCE


def test_whole_answers_are_the_same_or_the_self_test_fails(
    here: dict[str, np.ndarray], there: tuple[str, dict[str, np.ndarray]]
):
    """numpy 2.3.5 multiplies float32 wrongly on an Arm with SME."""
    name, there_result = there
    for what in here:
        if what.endswith("/answers"):
            sound, other = what.replace("answers", "sound"), there_result[what]
            print(f"{name}: {what}: {np.count_nonzero(other != here[what])} differ")
            assert here[sound]
            assert not there_result[sound] or other.tolist() == here[what].tolist()


def test_what_int8_computes_is_the_same_to_the_bit(
    here: dict[str, np.ndarray], there: tuple[str, dict[str, np.ndarray]]
):
    """One inner number in ten thousand may differ, where an earlier float was rounded otherwise."""
    name, there_result = there
    for what in here:
        if what.endswith(" inside/shown"):
            other = np.abs(there_result[what].astype(int) - here[what])
            print(
                f"{name}: {what}: {np.count_nonzero(other)} of {other.size} differ, by up "
                f"to {other.max()}"
            )
            assert np.mean(other > 0) < 1e-4


def test_an_x86_without_vnni_is_one(there: tuple[str, dict[str, np.ndarray]]):
    """Eight-bit weights overflow there, and only there: it would show a difference."""
    name, there_result = there
    exact = round(32 * 5 * 127 * 255 / 2**15)
    assert (there_result[f"{EIGHT_BITS}/shown"] == exact).all() == (
        name != "x86, AVX2 without VNNI"
    )
