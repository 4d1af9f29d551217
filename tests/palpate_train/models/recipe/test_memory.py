"""The memory of a fit does not grow with the set; too much is refused first."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.core.errors import FormatError
from palpate_train.data.run import Run
from palpate_train.data.sets import Dataset
from palpate_train.models.recipe import memory, recipe
from palpate_train.models.recipe.recipe import Settings
from tests.factories.sweep_sets import easy

USED = 120


@pytest.mark.slow
@pytest.mark.thorough  # fits twice
def test_memory_does_not_grow_with_the_set():
    """Thirty times the sweeps take as much beside themselves, within the estimate."""

    def peak(sweeps: Dataset) -> int:
        """The largest number of bytes that a fit to USED of these sweeps allocates beside them."""
        tracemalloc.start()
        try:
            recipe.fit(sweeps, Run(1), Settings(most=USED))
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    def repeated(times: int) -> Dataset:
        """The easy set several times, each time with other recordings and other noise."""
        s, rng = easy(20), np.random.default_rng(0)
        samples = np.concatenate([s.samples] * times)
        noisy = samples + rng.integers(-2, 3, samples.shape)
        limits = np.iinfo(samples.dtype)
        groups = {"recording": np.arange(len(samples)) // 2}
        noisy = noisy.clip(limits.min, limits.max).astype(samples.dtype)
        return replace(s, samples=noisy, labels=np.tile(s.labels, times), groups=groups)

    small, large = repeated(3), repeated(90)
    least, most = peak(small), peak(large)
    assert most < 1.1 * least + 64 * len(large), (least, most)  # 64: groups and labels
    assert most < memory.needed(large, USED), (most, memory.needed(large, USED))


def test_a_set_under_the_cap_is_used_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its results do not change with the cap; without a number nothing is refused."""
    s = easy(4)
    assert len(recipe.Setup.of(s, Run(1), Settings()).sweeps) == len(s)
    assert len(recipe.Setup.of(s, Run(1), Settings(most=9)).sweeps) == 9
    monkeypatch.setattr(memory, "MEMINFO", tmp_path / "none")
    monkeypatch.setattr(memory, "CGROUP", tmp_path / "none")
    memory.check(easy(4), 10**9)


@pytest.mark.parametrize(
    ("kilobytes", "limit", "advice"),
    [(1_000_000, "max", "1.0 GB"), (9_000_000, "500000000", "0.4 GB"), (100_000, "max", "0.1 GB")],
)
def test_what_cannot_be_held_is_told_before(
    kilobytes: int, limit: str, advice: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The needed and the free memory, and a number that fits; a container's limit counts."""
    (tmp_path / "meminfo").write_text(f"MemTotal: 1 kB\nMemAvailable: {kilobytes} kB\n")
    (tmp_path / "memory.max").write_text(limit + "\n")
    (tmp_path / "memory.current").write_text("100000000\n")
    monkeypatch.setattr(memory, "MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "CGROUP", tmp_path)
    s = easy(4)
    with pytest.raises(FormatError, match="100000 sweeps") as e:
        memory.check(s, 100_000)
    assert advice in str(e.value)
    if kilobytes > 300_000:
        memory.check(s, int(str(e.value).split("--most-sweeps ")[1].split(",")[0]))
