"""The throughput benchmark: contenders do what they are timed for; sums and ratios are right."""

import json

import numpy as np
import pytest
import torch

from benchmarks.speed import throughput
from benchmarks.speed.bare_process import SUBSTEPS
from bgpo_trl.configs import BGPOConfig, RLConfig
from suites import nico

frames = throughput.frames


def test_the_bare_loop_simulates_what_our_task_does():
    """The targets that it replays move the arms to where they were when these were recorded."""
    import mujoco

    starts, targets = frames.record()
    draw = frames.actions()
    environment = nico.load(frames.TASK, seed=0, observation="state", time_limit=float("inf"))
    environment.reset()
    model = mujoco.MjModel.from_xml_string(nico.scene_xml())
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, starts[0], mujoco.mjtState.mjSTATE_INTEGRATION)
    for step in range(10):
        environment.step(draw(frames.ROWS)[0])
        environment._reset_next_step = False
        data.ctrl[:] = targets[step, 0]
        mujoco.mj_step(model, data, SUBSTEPS)
    np.testing.assert_allclose(data.qpos[:12], environment.physics.data.qpos[:12], atol=0.02)
    assert np.abs(data.qpos[:3] - starts[0][1:4]).max() > 0.05


def test_ratios_are_against_the_named_contenders(monkeypatch):
    seconds = {
        "bare limit, 1 threads": [10.0, 20.0],
        "bare limit, 2 threads": [5.0, 10.0],
        "ours": [20.0, 40.0],
        "stock": [100.0, 200.0],
    }
    monkeypatch.setattr(frames, "contenders", lambda *a: dict.fromkeys(seconds, (None, 10)))
    monkeypatch.setattr(
        throughput,
        "load_pretrained",
        lambda *_, **__: (type("E", (), {"frame_network": None}), None),
    )
    monkeypatch.setattr(throughput, "interleave", lambda contenders, rounds, clock: seconds)
    row = throughput.measure_frames(throughput.Arguments(), threads=2)["ours"]
    assert row["frames a second"] == pytest.approx(10 / 30)
    assert row["share of the bare limit, 1 threads"] == pytest.approx(0.5)
    assert row["share of the bare limit, 2 threads"] == pytest.approx(0.25)
    assert row["times stock"] == pytest.approx(5)


def test_results_are_written_and_printed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch, "set_num_threads", lambda n: None)
    short = BGPOConfig(
        max_steps=3, rl=RLConfig(warmup_steps=3), demonstration_share=0.0, experts=False
    )
    monkeypatch.setattr(throughput, "BGPOConfig", lambda: short)
    throughput.main(
        throughput.Arguments(
            parts=("step", "memory"), seeds=2, rounds=2, steps=4, threads=1, out=tmp_path
        )
    )
    found = json.loads((tmp_path / "throughput.json").read_text())
    step = found["step"]
    assert step["2 runs of one seed"]["share of single runs"] == 1
    for part in ("simulate (physics and render)", "FrameEncoder", "act", "update", "store"):
        assert step[f"2 seeds in a batch: {part}"]["ms a step of all"] > 0
    whole = step["2 seeds in a batch: whole environment"]["ms a step of all"]
    inside = [step[f"2 seeds in a batch: {part}"] for part in ("FrameEncoder", "RewardSum")]
    assert sum(row["ms a step of all"] for row in inside) < whole
    rows = list(found["memory"].values())
    # Two latents, behavior, action, reward, two flags and the group, in the units of the table.
    size = 4 * (2 * 64 + 32 + 4 + 1) + 2 + 8
    assert rows[-2]["MB of it replay"] == pytest.approx(4 * 2 * size / 1e6)
    assert "| 2 seeds in a batch |" in capsys.readouterr().out
