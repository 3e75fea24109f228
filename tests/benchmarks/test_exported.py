"""A policy and its exported programs take turns at the same frames."""

import importlib.util
import re

import numpy as np
import pytest

from benchmarks.speed import exported
from bgpo_trl.policy import load_run
from tests.helpers import finish

pytestmark = pytest.mark.usefixtures("easy_world")


@pytest.fixture(scope="module")
def run(easy_world, begin, make_config, tmp_path_factory):
    directory = tmp_path_factory.mktemp("run") / "run"
    finish(begin(directory, make_config(episodes=3, eval_every=3)))
    return directory


def test_contenders_act_on_every_frame(run, tmp_path):
    policy = load_run(run)
    frames = np.random.default_rng(1).integers(0, 256, (3, 32, 64, 3), np.uint8)
    policy.condition(frames)
    acts, seen = exported.contenders(policy, tmp_path), {}

    def counted(name):
        return lambda frame: seen.setdefault(name, []).append(frame) or acts[name](frame)

    times = exported.measure({name: counted(name) for name in acts}, list(frames), rounds=2)
    assert {name: len(found) for name, found in times.items()} == dict.fromkeys(acts, 2)
    assert all(len(found) == 3 * 4 for found in seen.values())  # two rounds are for warming up
    assert all(found[4] is not found[3] and found[4] is found[1] for found in seen.values())


def test_the_table_has_all(run, capsys, monkeypatch):
    monkeypatch.setattr(exported, "set_threads", lambda n: None)
    exported.main(exported.Arguments(run, frames=2, rounds=3))
    _, _, ours, *others = capsys.readouterr().out.splitlines()
    number = r"[\d.]+ \([\d.]+-[\d.]+\)"
    assert re.fullmatch(rf"\| TrainedPolicy.act \| {number} \| 1.00 \(1.00-1.00\) \|", ours)
    names = [line.split(" | ")[0].strip("| ") for line in others]
    onnx = ["ONNX model"] if importlib.util.find_spec("onnxruntime") else []
    assert names == ["exported program", *onnx]
    for name, theirs in zip(names, others, strict=True):
        assert re.fullmatch(rf"\| {name} \| {number} \| {number} \|", theirs)
