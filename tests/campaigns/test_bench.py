"""The campaign `bench`: the keys of its JSON, and parts measured in own processes."""

from __future__ import annotations

import json
import re

import pytest

from palpate.bundle import bundle
from palpate.sim import script
from tests.campaigns import bench, bench_process


@pytest.mark.slow
def test_bench_writes_its_figures(tmp_path, monkeypatch, capsys):
    """A small bench: every key that scripts rely on, in JSON, with commit, seed and machine."""
    for name, value in {"SWEEPS": 6, "STARTS": 1, "ROUNDS": 5}.items():
        monkeypatch.setattr(bench, name, value)
    monkeypatch.setattr(bench, "_child", lambda name, seed: {name: {"seed": seed}})
    monkeypatch.setattr(bench, "_references", list)
    monkeypatch.setattr("sys.argv", ["bench", "--out", str(tmp_path / "b.json")])
    bench.main()
    figures = json.loads((tmp_path / "b.json").read_text())
    assert figures["accuracy"]["total"] == 6
    assert figures["frames_lost"] == 0
    assert figures["edge_to_sentence_ms"].keys() >= {"p50", "p99"}
    assert figures["inference_ms"]["int8"]["p50"] > 0
    assert figures["inference_ms"]["answer"]["p50"] > 0
    assert figures["cold_start_s"] > 0
    assert figures["memory"] == {"seed": 2000}
    assert {"commit", "seed", "machine"} <= figures.keys()
    on_disk = sum(file.stat().st_size for file in bundle.DEFAULT.iterdir())
    model = (bundle.DEFAULT / bundle.MODEL).stat().st_size
    assert figures["bundle_kb"] == {
        "model": pytest.approx(model / 1000, abs=0.05),
        "all": pytest.approx(on_disk / 1000, abs=0.05),
    }
    assert re.fullmatch(r"20\d\d-\d\d-\d\d", figures["date"])
    assert [len(figures["load_average"][when]) for when in ("before", "after")] == [3, 3]
    assert "edge_to_sentence_ms" in capsys.readouterr().out


@pytest.mark.slow
def test_bench_parts(tmp_path, monkeypatch):
    """Short measurements of memory and processor share."""
    monkeypatch.setattr(bench_process, "MEMORY_SWEEPS", 20)
    monkeypatch.setattr(bench_process, "STREAM_S", 0.5)
    acts, packaged = tmp_path / "acts.npz", bundle.load(bundle.DEFAULT)
    bench_process.write_acts(acts, script.tubes(1, 2))
    memory = bench_process.memory(packaged, acts)["rss_mb"]
    assert 10 < memory["without_board"] <= memory["after_1000"]
    shares = bench_process.stream(packaged, acts)
    assert 0 < shares["cpu_share_streaming"] < shares["cpu_share_with_simulated_board"]
