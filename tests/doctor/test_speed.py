import numpy as np
import pytest
from bgpo_trl.doctor.finding import Finding

from bgpo_trl.doctor import speed


def told(finding: Finding) -> tuple[str, str]:
    assert "\n" not in str(finding)
    return finding.level, finding.told


def test_few_frames_are_noted():
    assert told(speed.judge_frame_rate(400, 900, 4)) == ("ok", "400 on one core, 900 on 4")
    level, message = told(speed.judge_frame_rate(12, 20, 2))
    assert level == "note"
    assert message.startswith("12 on one core, 20 on 2: few; is the machine busy")


def test_rates_are_calls_a_second(monkeypatch):
    clock = iter(np.arange(0, 100, 0.25))
    monkeypatch.setattr(speed.time, "perf_counter", lambda: float(next(clock)))
    calls = []
    rate = speed._rate(lambda: calls.append(1), seconds=2.0)
    assert rate == pytest.approx((len(calls) - 1) / 2.0)  # the first call is not timed
    assert len(calls) > 5


def test_speed_is_measured():
    (frames,) = speed.check_frame_rate(seconds=0.05)
    assert frames.level in ("ok", "note")
    weights, updates = speed.check_update_rate(seconds=0.05)
    assert told(weights) == ("ok", "encoders and 3,600 embedded demonstrations")
    assert int(updates.told.split(",")[0]) > 0
