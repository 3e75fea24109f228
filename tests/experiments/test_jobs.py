"""Jobs on a Ray of this machine."""

import os
import signal
import sys
import tempfile
import threading
import time
from types import SimpleNamespace

import pytest

from bgpo_trl.configs import RunConfig
from bgpo_trl.experiments import sweep as jobs
from bgpo_trl.experiments.arguments import Arguments
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.experiments.sweep import Job
from tests.helpers import rows


@pytest.fixture(scope="module")
def folder():
    """Of all that Ray writes: short, for its sockets."""
    with (
        tempfile.TemporaryDirectory(prefix="ray", dir="/tmp", ignore_cleanup_errors=True) as folder,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("RAY_TMPDIR", folder)
        patch.setenv("RAY_worker_niceness", "0")
        yield folder


@pytest.fixture(scope="module")
def ray(folder):
    """Ray as sweeps start it; other tests of this process ask who handles SIGTERM."""
    before = signal.getsignal(signal.SIGTERM)
    with jobs.connected("local", 1, 0):
        yield
    signal.signal(signal.SIGTERM, before)


def make_jobs(folder, names, episodes=6):
    return [
        Job(folder / name, RunConfig(seeds=(seed,), episodes=episodes))
        for seed, name in enumerate(names)
    ]


def make_play():
    """Made here, it goes to the workers as it is, though they cannot import this module."""

    def play(job):
        import os
        import signal
        import time

        path, name = job.directory / "train.csv", job.directory.name
        if not path.exists():
            path.write_text("seed,episode,pid\n")
        there = path.read_text().count("\n")  # which is where a checkpoint would have it go on
        for episode in range(there, job.config.episodes + 1):
            with path.open("a") as file:
                file.write(f"{job.config.seeds[0]},{episode},{os.getpid()}\n")
            if name == "dies always" or (name == "dies" and there == 1 and episode == 3):
                os.kill(os.getpid(), signal.SIGKILL)
            if name == "fails" and episode == 2:
                raise ValueError("a mistake\nof two lines")
        while name == "waits":
            try:
                time.sleep(0.1)
            except KeyboardInterrupt:
                (job.directory / "saved").touch()
                raise
        (job.directory / "final.csv").touch()
        (job.directory / "summary.json").write_text(f'{{"episodes": {job.config.episodes}}}')

    return play


def test_jobs_survive_lost_workers_but_not_their_own_errors(ray, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(jobs, "RETRIES", 1)
    todo = make_jobs(tmp_path, ["dies", "fails", "dies always"])
    failed = jobs.play_jobs(todo, make_play(), cpus=0.5)
    reasons = {job.directory.name: reason for job, reason in failed.items()}
    assert reasons.pop("fails") == "ValueError: a mistake"
    assert reasons.pop("dies always").startswith("WorkerCrashedError: ")
    assert not reasons
    printed = capsys.readouterr().out.splitlines()  # among what Ray says of workers that died
    starts = {"dies": 2, "fails": 1, "dies always": 2}
    for job, (name, n_starts) in zip(todo, starts.items(), strict=True):
        assert job.finished == (name == "dies")
        state = "finished" if job.finished else "failed"
        assert printed.count(f"{tmp_path.name}/{name}: {state}") == 1
        assert (job.directory / "log.txt").read_text().count(" process ") == n_starts
        assert len({row["pid"] for row in rows(job.directory / "train.csv")}) == n_starts
    played = rows(todo[0].directory / "train.csv")
    assert [int(row["episode"]) for row in played] == [1, 2, 3, 4, 5, 6]
    assert "ValueError: a mistake\nof two lines" in (tmp_path / "fails" / "log.txt").read_text()


def test_ctrl_c_interrupts_the_runs(ray, tmp_path):
    todo = make_jobs(tmp_path, ["waits"])

    def interrupt():
        while not (tmp_path / "waits" / "train.csv").exists():
            time.sleep(0.1)
        signal.raise_signal(signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        jobs.play_jobs(todo, make_play())
    assert (tmp_path / "waits" / "saved").exists()
    assert not todo[0].finished


def test_a_job_waits_for_the_lock_and_skips_a_finished_run(make_config, tmp_path, other_process):
    """It goes on once the other process is gone, and does not play again what that one ended."""
    job, played = Job(tmp_path / "run", make_config()), []
    other = other_process(job.directory)
    assert other.stdout.readline() == "has it\n"
    thread = threading.Thread(target=jobs.work, args=(job, played.append, sys.argv))
    thread.start()
    thread.join(0.3)
    assert thread.is_alive()
    (job.directory / "final.csv").touch()
    summary = job.directory / "summary.json"
    summary.write_text(f'{{"episodes": {job.config.episodes}}}')
    other.communicate("\n")
    thread.join(20)
    assert not thread.is_alive() and not played
    summary.unlink()
    jobs.work(job, played.append, sys.argv)
    assert played == [job]
    assert (job.directory / "log.txt").read_text().count(f"process {os.getpid()} on") == 1


def test_a_machine_without_enough_cores_or_gpus_is_refused(monkeypatch):
    ended = []
    stub = SimpleNamespace(
        init=lambda *_, **__: None,
        cluster_resources=lambda: {"CPU": 2.0},
        shutdown=lambda: ended.append(1),
    )
    monkeypatch.setitem(sys.modules, "ray", stub)
    too_many = ((3, 0, "--cpus-per-run 3: Ray finds 2"), (2, 0.5, "--gpus-per-run"))
    for cpus, gpus, message in too_many:
        with pytest.raises(ValueError, match=message), jobs.connected("local", cpus, gpus):
            raise AssertionError("went on")
    with jobs.connected("auto", 8, 1):  # a cluster may grow
        assert len(ended) == 2
    assert len(ended) == 3


def test_a_missing_ray_names_the_extra_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)

    def sweep(arguments: Arguments):
        with jobs.connected("local", 1, 0):
            raise AssertionError("went on")

    with pytest.raises(SystemExit, match=r"^error: [^\n]*pip install 'bgpo_trl\[ray\]'$"):
        command_line(sweep, [])
