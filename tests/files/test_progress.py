import io

import pytest

from bgpo_trl.files.progress import progress_bar


@pytest.mark.parametrize(("terminal", "drawn"), [(True, range(95, 110)), (False, range(3, 9))])
def test_a_bar_is_redrawn_more_often_on_a_terminal_than_in_a_log(monkeypatch, terminal, drawn):
    """A hundred seconds, an update in each."""
    stream, seconds = io.StringIO(), [0.0]
    monkeypatch.setattr(stream, "isatty", lambda: terminal)
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr("tqdm.std.time", lambda: seconds[0])
    with progress_bar("train", total=100, unit="episode") as bar:
        for _ in range(100):
            seconds[0] += 1.0
            bar.set_postfix_str(f"success {bar.n / 100:.2f}", refresh=False)
            bar.update()
    lines = stream.getvalue().split("\r")[1:]
    assert len(lines) in drawn
    assert "train:   0%" in lines[0]
    assert "100/100" in lines[-1]
    assert "success 0.99" in lines[-1]
    assert all("<" in line for line in lines[1:])  # elapsed<left
